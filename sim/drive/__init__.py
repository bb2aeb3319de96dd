"""Driving: a gait, a plan or recorded commands, run on the twin or over a bus."""
