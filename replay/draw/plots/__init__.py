"""Plots: angles, power, the gait, and topics of foreign logs."""
