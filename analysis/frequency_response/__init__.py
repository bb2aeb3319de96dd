"""Frequency responses from any excitation."""
