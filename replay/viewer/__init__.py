"""The viewer process, with and without a window."""
