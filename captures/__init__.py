"""Captures: what was on the line and when, in MCAP. Knows files, not ports, cases or colour."""
