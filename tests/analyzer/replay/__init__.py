"""Tests of `bilprov.analyzer.replay`."""
