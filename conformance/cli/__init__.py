"""The suite's commands: they read options, call the rooms below, and show the result."""
