"""What is measured, one command each; nothing here is asserted."""
