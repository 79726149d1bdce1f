"""The protocol, read from one grammar. Pure code: no port, file, clock, thread or colour."""
