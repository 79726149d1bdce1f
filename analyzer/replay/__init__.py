"""Records sessions into captures, and replays captures on a screen or against a device."""
