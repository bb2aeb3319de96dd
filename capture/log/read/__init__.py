"""Sessions, and joint signals on their sampling times."""
