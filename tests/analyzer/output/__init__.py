"""Tests of `bilprov.analyzer.output`."""
