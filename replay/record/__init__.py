"""Sessions as .rrd files."""
