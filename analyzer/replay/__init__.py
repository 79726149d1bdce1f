"""Sessions recorded, captures played."""
