"""Models of identical modules, from runs of the twin."""
