"""Ports, ptys, sockets, signals."""
