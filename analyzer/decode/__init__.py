"""Decodes bytes with timestamps into records: frames and answers, paired. Uses no port or clock."""
