"""Conformance judged from ordinary traffic."""
