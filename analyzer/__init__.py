"""The protocol analyzer: ports, taps, decoding, recording, replay, and the output of results."""
