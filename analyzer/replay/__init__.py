"""Records a session into a capture, and replays one on a screen or against a device."""
