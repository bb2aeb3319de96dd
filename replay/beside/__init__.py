"""Sessions side by side: bodies overlaid, plots of all of them, and their differences."""
