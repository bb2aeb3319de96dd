"""A session while it is recorded: the relay between a recorder and the viewer."""
