"""Contact of the links with the ground."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.estimate import Estimate

TWIN_ACCURACY = (0.86, 0.93)
"""How often it is right in the twin: the least and the largest mean, over gaits that lift links, of
the shares of contacts and of lifted links that are recognised (``studies/contact_tables.py``)."""


@dataclass(frozen=True)
class LinkContact:
    """Ground contact of one link.

    Attributes:
        link: Name of the link.
        share: Of a cycle that it is on the ground.
        load: Mean load, over the mean weight of a link.
        by_phase: Share of the cycles in which it is on the ground, in successive equal parts of a
            cycle from the start of the whole cycles.
    """

    link: str
    share: Estimate
    load: float
    by_phase: tuple[float, ...]


@dataclass(frozen=True)
class GroundContact:
    """Ground contact of the links, from the torques of the joints.

    Attributes:
        source: Where the torques are from: effort or current.
        links: Head to tail.
        twin_accuracy: How often contact is recognised rightly in the twin: mean of the shares of
            contacts and of lifted links that are recognised, of the worst and the best gait; 0.5
            is chance.
    """

    source: str
    links: tuple[LinkContact, ...]
    twin_accuracy: tuple[float, float] = TWIN_ACCURACY
