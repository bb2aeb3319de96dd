"""The parts and the write-ahead log of a session as one list of blocks."""
