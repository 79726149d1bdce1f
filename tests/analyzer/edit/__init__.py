"""Tests of `bilprov.analyzer.edit`."""
