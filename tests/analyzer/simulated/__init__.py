"""Tests of `bilprov.analyzer.simulated`."""
