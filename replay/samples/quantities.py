"""What is plotted of a session: as logged, and what follows from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray

from .content import COMMANDED, ERROR, MEASURED, MECHANICAL, TOTAL
from .tracks import Columns, Track, hold, interpolate, pairs


def tracking_errors(measured: Sequence[Track], commanded: Sequence[Track]) -> tuple[Track, ...]:
    """Return measured minus commanded angles, at the measurement's times.

    Args:
        measured: Measured angles [rad].
        commanded: Commanded angles [rad].

    Returns:
        A track for each joint that has both [rad]; the command is the last one given by then.
    """
    return tuple(
        Track(one.name, one.t_ns, one.values - hold(other.t_ns, other.values, one.t_ns))
        for one, other in pairs(measured, commanded)
    )


def mechanical_power(columns: Columns) -> tuple[Track, ...]:
    """Return the power at the joints, tau q', at the sampling times of the efforts.

    Args:
        columns: The session's columns.

    Returns:
        A track [W] for each joint with effort and velocity; positive where the joint drives.
    """
    effort, velocity = (columns.get(("/joint_states", one), ()) for one in ("effort", "velocity"))
    return products(effort, velocity)


def electrical_power(columns: Columns) -> tuple[Track, ...]:
    """Return the power of the motors, u i, at the sampling times of the currents.

    Args:
        columns: The session's columns.

    Returns:
        A track [W] for each joint with current and voltage.
    """
    return products(
        columns.get(("/joint_current", "position"), ()),
        columns.get(("/joint_voltage", "position"), ()),
    )


def products(first: Sequence[Track], second: Sequence[Track]) -> tuple[Track, ...]:
    """Return the product of two quantities of each joint.

    Returns:
        A track for each joint that has both; NaN where either is missing.
    """
    return tuple(
        Track(one.name, one.t_ns, one.values * interpolate(other.t_ns, other.values, one.t_ns))
        for one, other in pairs(first, second)
    )


def total(tracks: Sequence[Track]) -> Track | None:
    """Return the sum over the joints, at the first joint's sampling times.

    Args:
        tracks: The joints' power [W].

    Returns:
        The sum [W], NaN where any joint's power is missing; None without joints.
    """
    if not tracks:
        return None
    t_ns = tracks[0].t_ns
    parts = [interpolate(track.t_ns, track.values, t_ns) for track in tracks]
    return Track("total", t_ns, np.sum(parts, axis=0))


def power_limit(power_w: FloatArray) -> float:
    """Return the power at which the colour is full: the 99th percentile of its magnitude.

    Args:
        power_w: Mechanical power [W], any shape; NaN where it isn't known.

    Returns:
        [W], rounded up to two digits so that it can be written beside the picture; 1 where no
        power is known or all of it is zero.
    """
    known = np.abs(power_w[np.isfinite(power_w)])
    limit = float(np.percentile(known, 99.0)) if known.size else 0.0
    if limit <= 0.0:
        return 1.0
    unit = 10.0 ** (np.floor(np.log10(limit)) - 1.0)
    return float(np.ceil(limit / unit) * unit)


def segment_power(joint_power_w: FloatArray) -> FloatArray:
    """Share of the joints' power that each link shows: half of that of the joint at either end.

    Args:
        joint_power_w: Mechanical power of the joints [W], shape (..., m).

    Returns:
        [W], shape (..., m + 1); the sum over the links is the sum over the joints.
    """
    half = joint_power_w / 2.0
    shares = np.zeros((*half.shape[:-1], half.shape[-1] + 1))
    shares[..., :-1] += half
    shares[..., 1:] += half
    return shares


DRAWN = {"/joint_states", "/joint_commands", "/gait"}
"""JointState topics that have views of their own."""

SIGNALS = "/signals"


def topic_entity(root: str, topic: str) -> str:
    """Return the entity of a topic.

    Args:
        root: E.g. ``/signals``.
        topic: Any name; it may come from a foreign bag.

    Returns:
        The path of its entity, each part escaped, and empty ones left out.
    """
    parts = (rr.escape_entity_path_part(part) for part in topic.split("/") if part)
    return "/".join((root, *parts))


def quantities(columns: Columns) -> dict[str, tuple[Track, ...]]:
    """Return the plotted quantities.

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
        if (whole := total(tracks)) is not None:
            found[f"{TOTAL}/{kind}"] = (whole,)
    found |= {
        topic_entity(SIGNALS, topic): tracks
        for (topic, field), tracks in columns.items()
        if topic not in DRAWN and field == "position"
    }
    return {entity: tracks for entity, tracks in found.items() if tracks}
