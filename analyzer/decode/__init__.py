"""Timed bytes in, frames with their answers out."""
