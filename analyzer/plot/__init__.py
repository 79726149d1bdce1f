"""Draws a capture along its time on one self-contained HTML page. Decodes nothing itself."""
