"""The recorder: sources in, a session out."""
