"""The analyzer: ports, taps, pairing, decoding sessions, and how they are shown."""
