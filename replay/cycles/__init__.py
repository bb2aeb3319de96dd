"""Cycles of a gait: steps and maps of what each did, and the mean of all."""
