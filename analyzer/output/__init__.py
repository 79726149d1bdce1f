"""Shows records as text, JSON lines, live view and tables; filters, counts, but changes none."""
