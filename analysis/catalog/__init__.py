"""Many sessions: found by robot, gait, date, verdict and results, and compared over weeks."""
