"""Tests of `bilprov.conformance.dut`."""
