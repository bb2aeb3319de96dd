"""Several sessions as runs of one experiment: what they are, and one answer from all."""
