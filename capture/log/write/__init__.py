"""The session writer and its channels."""
