"""Which times of a log are dates, and where one is put whose times count from its own start."""

RELATIVE_EPOCH_NS = 946_684_800_000_000_000
"""Where a log without a date is put: 2000-01-01T00:00:00Z [Unix ns]."""

EARLIEST_NS = 100_000_000_000_000_000
"""A time below this is no date but a time since the log's start [ns]: 1973."""

LATEST_NS = 2**31 * 1_000_000_000
"""No stamp of a message can hold this time or a later one [Unix ns]: 2038."""
