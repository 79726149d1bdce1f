"""Tests of `bilprov.analyzer.doctor`."""
