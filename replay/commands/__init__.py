"""The commands that view and replay sessions and fit the twin."""
