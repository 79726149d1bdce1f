"""Decodes much traffic at once into columns: arrays with one row a frame. Needs numpy."""
