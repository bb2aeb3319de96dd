"""Comparison of the joints of a session, and what it says."""
