"""Tests of `bilprov.conformance.cases`."""
