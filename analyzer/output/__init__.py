"""Shows records as text, JSON lines, CSV and tables; counts them, but changes none."""
