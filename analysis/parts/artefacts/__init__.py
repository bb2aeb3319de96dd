"""What is wrong with samples, or at a limit."""
