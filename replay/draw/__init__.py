"""Samples as Rerun entities: the scene, plots, cycles of a gait."""
