"""Logs of other makes, in and out: CAN traces, CSV."""
