"""Tests of `bilprov.conformance.mutation`."""
