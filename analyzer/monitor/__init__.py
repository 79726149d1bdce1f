"""Judges a device from ordinary traffic and counts what that covers. Never sends anything."""
