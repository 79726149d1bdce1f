"""The conformance suite: takes a device through test cases. What it cannot see is never a pass."""
