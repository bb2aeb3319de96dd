"""Calibrate the twin: which servos and which ground would have answered as a session did."""
