"""Output of records as text, JSON lines, live view and tables, with filters and statistics."""
