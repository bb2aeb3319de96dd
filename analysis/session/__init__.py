"""One session: its numbers, put together."""
