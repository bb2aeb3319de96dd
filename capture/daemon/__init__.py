"""The recorder: sources in, a session out, for as long as it takes."""
