"""What is drawn in space: the body, what it sees and what stands around it."""
