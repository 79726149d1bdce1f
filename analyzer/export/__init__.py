"""Captures written for other programs, a module for each format; memory does not grow with them."""
