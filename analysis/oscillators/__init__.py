"""Coupled oscillators: their own couplings, and those through the body.

The chain of oscillators of Eq. 1 of Meister, Stepanenko & Kernbach 2011 is estimated from its own
kicked phases (:mod:`.weak_form`, :mod:`.chain`). The coupling through the body is estimated from
open-loop kicks: the matrix P read as entrainment and as a signed Laplacian (:mod:`.laplacian`),
which predicts how oscillators with feedback relax (:mod:`.predictions`).
"""
