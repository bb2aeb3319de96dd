"""Frames of a CAN bus, and what they mean by DBC and bus map."""
