"""Tests of `captures`."""
