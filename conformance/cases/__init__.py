"""Test cases as values (preamble, stimulus, expectation), their generation and their selection."""
