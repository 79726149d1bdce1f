"""Tests of `bilprov.conformance.report`."""
