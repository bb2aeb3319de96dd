"""Frequency, gain and lag of a gait, fitted to commands and positions; responses from any excitation."""
