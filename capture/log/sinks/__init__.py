"""Where messages are written: a file, a file and its write-ahead log, or a ring in memory."""
