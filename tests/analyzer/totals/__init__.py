"""Tests of `bilprov.analyzer.totals`."""
