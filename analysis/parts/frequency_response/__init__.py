"""Frequency responses of joints, from any excitation."""
