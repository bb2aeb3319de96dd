"""Parts of the analysis, each in a folder of its own: measure, result, show."""
