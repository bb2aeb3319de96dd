"""The log: messages, MCAP storage, the session writer and reader."""
