"""MCAP files, read block by block and written."""
