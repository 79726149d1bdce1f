"""The report of a run: written in every format, read, compared. Drives no device."""
