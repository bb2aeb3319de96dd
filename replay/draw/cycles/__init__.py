"""Cycles of a gait: values of each, maps, and the mean of all."""
