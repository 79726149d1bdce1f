"""The device under test and how it is reached."""
