"""The part that fits the gait of the window."""
