"""Finite-state machines and their complete test suites: the Wp-method. Knows no protocol."""
