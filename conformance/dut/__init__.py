"""The device under test and how it is reached: links, probes, power, simulator, emulated boards."""
