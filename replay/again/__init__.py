"""Run a recorded experiment again in the twin, and say what differs."""
