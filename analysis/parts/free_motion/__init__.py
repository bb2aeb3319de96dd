"""A motion without commands: its waves along the body."""
