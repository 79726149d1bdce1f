"""Records as text, JSON lines, live view, tables."""
