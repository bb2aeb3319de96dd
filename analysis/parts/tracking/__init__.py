"""Gain, lag and offset of each joint in any motion, and which joints differ from the others."""
