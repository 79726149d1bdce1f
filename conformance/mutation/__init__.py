"""Faulty devices, legal variants, the score."""
