"""Serial ports, ptys, sockets and signals; the only room with pyserial. Knows no frames."""
