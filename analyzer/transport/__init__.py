"""Serial ports, ptys, sockets and signals; the only package that uses pyserial and select."""
