"""Results: frozen values at the border between estimators and readers of results."""
