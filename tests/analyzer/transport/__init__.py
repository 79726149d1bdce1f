"""Tests of `bilprov.analyzer.transport`."""
