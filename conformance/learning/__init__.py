"""Learns a device as a Mealy machine, and compares it with the machine of the Protocol."""
