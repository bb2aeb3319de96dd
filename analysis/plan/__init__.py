"""Plans: sessions of commands to drive, whose recordings are one experiment."""
