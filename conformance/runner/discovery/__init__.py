"""Experiments that show what a device chooses where the document is silent."""
