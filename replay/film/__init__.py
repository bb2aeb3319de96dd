"""The body as GIF or MP4."""
