"""What is plotted of a session: as logged, and what follows from it."""

from __future__ import annotations

import rerun as rr

from ..plots.joints import (
    COMMANDED,
    ERROR,
    MEASURED,
    tracking_errors,
)
from ..plots.power import (
    MECHANICAL,
    TOTAL,
    electrical_power,
    mechanical_power,
    total,
)
from .tracks import Columns, Track

DRAWN = {"/joint_states", "/joint_commands", "/gait"}
"""JointState topics that have views of their own."""

SIGNALS = "/signals"


def topic_entity(root: str, topic: str) -> str:
    """Where a topic goes.

    Args:
        root: E.g. ``/signals``.
        topic: Any name; it may come from a foreign bag.

    Returns:
        The path of its entity, each part escaped, and empty ones left out.
    """
    parts = (rr.escape_entity_path_part(part) for part in topic.split("/") if part)
    return "/".join((root, *parts))


def quantities(columns: Columns) -> dict[str, tuple[Track, ...]]:
    """The plotted quantities.

    Args:
        columns: JointState columns, of the whole session or of a stretch of it.

    Returns:
        Entity to its lines: angles [rad], power [W], and every other JointState topic in its own
        unit below ``/signals``; none without a line.
    """
    measured = columns.get(("/joint_states", "position"), ())
    commanded = columns.get(("/joint_commands", "position"), ())
    mechanical, electrical = mechanical_power(columns), electrical_power(columns)
    found = {
        COMMANDED: commanded,
        MEASURED: measured,
        ERROR: tracking_errors(measured, commanded),
        MECHANICAL: mechanical,
    }
    for kind, tracks in (("electrical", electrical), ("mechanical", mechanical)):
        whole = total(tracks)
        if whole is not None:
            found[f"{TOTAL}/{kind}"] = (whole,)
    found |= {
        topic_entity(SIGNALS, topic): tracks
        for (topic, field), tracks in columns.items()
        if topic not in DRAWN and field == "position"
    }
    return {entity: tracks for entity, tracks in found.items() if tracks}
