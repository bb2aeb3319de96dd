"""The commands that simulate, serve and drive."""
