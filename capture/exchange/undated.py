"""Where logs are put that have no date: their times count from their own start."""

RELATIVE_EPOCH_NS = 946_684_800_000_000_000
"""Where a log without a date is put: 2000-01-01T00:00:00Z [Unix ns]."""

EARLIEST_NS = 100_000_000_000_000_000
"""A time below this is no date but a time since the log's start [ns]: 1973."""
