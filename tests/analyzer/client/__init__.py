"""Tests of `bilprov.analyzer.client`."""
