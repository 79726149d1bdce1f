"""What is written out of the Protocol for other programs, one file for each form."""
