"""Tests of `bilprov.conformance.causes`."""
