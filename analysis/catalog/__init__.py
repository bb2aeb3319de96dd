"""Find sessions by robot, gait, date, verdict and results."""
