"""MCAP bytes in, whole records out."""
