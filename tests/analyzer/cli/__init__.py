"""Tests of `bilprov.analyzer.cli`."""
