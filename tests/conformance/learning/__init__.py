"""Tests of learning a device."""
