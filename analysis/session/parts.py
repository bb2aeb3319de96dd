"""The parts of the analysis of a session, each from the file ``part.py`` of its folder."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any

from .. import parts
from ..parts.part import Part

FIRST = (
    *("judgement", "artefacts", "gait", "dead_band", "frequency_response", "tracking", "gaits"),
    *("energies", "joints", "energy", "over_time", "body", "ground_contact", "heterogeneity"),
    *("comparison", "free_motion", "closed_loop", "oscillators"),
)
"""Of parts that could be next the first of these is measured first, then others by their names.

Their warnings come in this order; what a part reads is measured before it in any case."""

UNCOMPARED = ("dead_band",)
"""Parts whose results no comparison and no sweep reads; a third of the time of a short session."""

BEYOND_THE_GAIT = (*UNCOMPARED, "body", "ground_contact")
"""Parts that who asks for the gait and its joints does without: two fifths of the time of a long
session."""


def _listed() -> tuple[Part[Any], ...]:
    listed: list[Part[Any]] = []
    for folder in iter_modules(parts.__path__, f"{parts.__name__}."):
        name = f"{folder.name}.part"
        if folder.ispkg and find_spec(name) is not None:
            listed += import_module(name).PARTS
    ranks = {name: rank for rank, name in enumerate(FIRST)}
    return tuple(sorted(listed, key=lambda part: (ranks.get(part.name, len(FIRST)), part.name)))


PARTS = _listed()
"""All parts of this package."""
