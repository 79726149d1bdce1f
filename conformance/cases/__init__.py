"""Every test case as a value."""
