"""Stick and play: dead bands at the reversals of a joint."""
