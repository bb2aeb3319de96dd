"""Boundary or module: the wave run the other way must mirror the profile."""
