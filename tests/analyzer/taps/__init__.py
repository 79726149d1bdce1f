"""Tests of `bilprov.analyzer.taps`."""
