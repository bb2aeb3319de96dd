"""Formats of other tools: each in one file, which recognises, reads and writes it."""
