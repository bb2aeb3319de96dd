"""Joints that do not follow their command: which, since when, and what kinds of fault fit.

Pure functions on arrays (:mod:`~.capture.following.find`), so that the health of a log, its
analysis and its replay name the same joints.
"""
