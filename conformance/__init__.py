"""The conformance suite: cases, the runner that asks, the drive that does, and the simulator."""
