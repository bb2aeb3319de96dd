"""Gain and lag of a gait, and frequency responses from any excitation."""
