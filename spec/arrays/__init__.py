"""Judges whole arrays of frames and answers of any layout at once. Needs numpy."""
