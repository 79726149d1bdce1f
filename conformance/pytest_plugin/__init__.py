"""Each case as a pytest test."""
