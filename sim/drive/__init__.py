"""Driving: a gait, a plan or recorded commands, run on the twin or, through a gate, over a bus."""
