"""Which links are on the ground, from the joints' torques."""
