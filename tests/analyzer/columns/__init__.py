"""Tests of `bilprov.analyzer.columns`."""
