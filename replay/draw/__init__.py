"""Samples as Rerun entities."""
