"""Tests of `bilprov.analyzer.plot`."""
