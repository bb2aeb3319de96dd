"""A recorded experiment run again in the twin or on a bus, and compared."""
