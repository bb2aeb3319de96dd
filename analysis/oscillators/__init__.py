"""Coupled oscillators: what couples them, and what couples them through the body.

The chain of oscillators that Eq. 1 of Meister, Stepanenko & Kernbach 2011 speaks of is told from
its own kicked phases (:mod:`.weak_form`). What the body would add is told from open-loop kicks: the
matrix P read as entrainment (:mod:`.entrainment`) and as a signed Laplacian (:mod:`.laplacian`),
which predicts how oscillators with feedback relax (:mod:`.embodied`).
"""
