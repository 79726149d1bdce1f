"""Tests of the reference firmware and of emulated boards."""
