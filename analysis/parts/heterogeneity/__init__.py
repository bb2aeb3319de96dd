"""Indices of heterogeneity along the body."""
