"""The protocol, said once and read out of one grammar. No port, file, clock, thread or colour."""
