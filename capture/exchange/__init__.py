"""Logs of other makes, in and out: CAN traces, tables, arrays, data sets for learning."""
