"""Boards under emulation: real firmware as a device of the kit."""
