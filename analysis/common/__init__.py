"""Values, remarks and formats that all of the analysis shares."""
