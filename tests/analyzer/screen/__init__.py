"""Tests of `bilprov.analyzer.screen`."""
