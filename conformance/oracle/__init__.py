"""What a conforming device does."""
