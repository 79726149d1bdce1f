"""Tests of `analyzer`."""
