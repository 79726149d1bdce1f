"""Scores the suite: by faulty devices, which it must fail, and legal ones, which it must pass."""
