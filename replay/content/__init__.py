"""What a recording for Rerun contains, by name."""
