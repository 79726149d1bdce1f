"""Tests of `bilprov.conformance.oracle`."""
