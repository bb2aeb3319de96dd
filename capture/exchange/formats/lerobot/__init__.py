"""LeRobot datasets: episodes of commands and states, for learning."""
