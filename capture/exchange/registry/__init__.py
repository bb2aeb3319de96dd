"""The formats that there are, and the choice of one for a file."""
