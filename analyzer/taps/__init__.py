"""What is put on or into a line."""
