"""The full screen of sniff and replay: a recording as packed columns, and its panes."""
