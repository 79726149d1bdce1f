"""Tests of `bilprov.analyzer.export`."""
