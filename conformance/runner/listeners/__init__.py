"""Executes cases over a link."""
