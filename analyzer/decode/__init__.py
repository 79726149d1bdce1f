"""Decodes bytes with times into records: frames paired with answers. Uses no port and no clock."""
