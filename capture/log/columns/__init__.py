"""Messages of a log as columns of numbers."""
