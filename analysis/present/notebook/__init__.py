"""Results in a notebook: they print, plot, become pandas frames, and go to files and back.

Every result is a :class:`.analysis.results.shown.Shown`; what it can do lives here and is imported
when it is used.
"""
