"""Motion, shape and travel of the whole body."""
