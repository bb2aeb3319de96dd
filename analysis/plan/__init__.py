"""Plans: sessions of commands to drive, so that an experiment can be told from what comes back."""
