"""The robot's sensors: what they measure, when, and how wrongly."""
