"""Counts and figures over a whole recording, kept up to date batch by batch. Needs numpy."""
