"""Finite-state machines and their complete test suites: pure theory, no protocol in it."""
