"""Results in a notebook: they print, plot, become pandas frames, and go to files and back.

Every result is a :class:`.analysis.results.estimate.PresentedResult`; its methods are here, and are
imported when they are used.
"""
