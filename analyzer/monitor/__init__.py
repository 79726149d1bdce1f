"""Passive conformance: judges a device from ordinary traffic; counts coverage and violations."""
