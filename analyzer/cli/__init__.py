"""The analyzer's commands."""
