"""Generates files for other programs from the Protocol, a module for each; opens none itself."""
