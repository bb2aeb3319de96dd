"""Samples on the way from the session to what is drawn: columns, times, stretches, rounding."""
