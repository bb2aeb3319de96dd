"""The scene: body, sensors, surroundings."""
