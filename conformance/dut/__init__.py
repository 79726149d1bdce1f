"""Reaches the device under test: links, probes, power, simulator, emulators. Never judges it."""
