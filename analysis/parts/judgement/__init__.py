"""Whether joints follow their commands."""
