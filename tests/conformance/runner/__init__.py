"""Tests of `bilprov.conformance.runner`."""
