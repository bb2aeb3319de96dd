"""Which segments respond differently, and in which shape the rest differs."""
