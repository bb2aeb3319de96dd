"""Responses cycle by cycle."""
