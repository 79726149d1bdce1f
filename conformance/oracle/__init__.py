"""The oracle: what a conforming device does, and the verdict of a deviation. Sends nothing."""
