"""Generates test cases (preamble, stimulus, expectation) as values, and selects. Runs none."""
