"""The session writer, its channels, and where messages go: a file, a log before it, a ring."""
