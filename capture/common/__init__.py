"""Files, text, errors and types that all packages use."""
