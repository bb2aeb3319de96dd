"""A session in a viewer that runs: the beginning at once, the rest while it is looked at."""
