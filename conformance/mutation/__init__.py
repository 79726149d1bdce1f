"""Faulty devices, legal variants, and the suite's mutation score."""
