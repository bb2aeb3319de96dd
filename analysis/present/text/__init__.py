"""Results as sentences and tables for a terminal."""
