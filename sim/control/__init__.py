"""Adaptive control: how distances and the compass change a gait."""
