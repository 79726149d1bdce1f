"""Captures written for other programs; memory does not grow with them."""
