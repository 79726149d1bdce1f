"""The full screen of sniff, replay and browse: a recording as packed columns, and its panes."""
