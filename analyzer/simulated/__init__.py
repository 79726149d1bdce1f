"""A simulated device of any grammar, and drawn requests to it."""
