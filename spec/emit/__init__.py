"""Emitters: files generated from the Protocol for other programs, one module for each form."""
