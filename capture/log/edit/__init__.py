"""Logs cut, merged and recovered."""
