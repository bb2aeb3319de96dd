"""The write-ahead log: what keeps accepted messages when a process is killed."""
