"""Tests of `bilprov.analyzer.decode`."""
