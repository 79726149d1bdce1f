"""Writes HTML pages that load nothing from elsewhere; foreign text is escaped. Knows no records."""
