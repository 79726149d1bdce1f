"""Reads MCAP records, complete ones only: what is inconsistent is rejected, never guessed."""
