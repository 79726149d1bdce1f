"""Tests of `bilprov.analyzer.filters`."""
