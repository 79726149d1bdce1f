"""The report of a run: written in every format, read, merged, compared. Drives no device."""
