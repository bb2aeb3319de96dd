"""The columns and the time window that an analysis uses, and the artefacts in them."""
