"""What is plotted: angles, power, the gait, responses, and what a foreign bag has."""
