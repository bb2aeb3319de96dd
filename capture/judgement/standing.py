"""Kinds of a joint that stands still, or moves the wrong way: what other channels prove.

A servo computes effort and velocity from its own encoder: with a frozen encoder it pushes as
against a block. So they tell a frozen sensor from a jammed joint only where they are measured
outside of its loop; a second position sensor always is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from .fault import Span
from .levels import GAIN_MARGIN, HALF, QUARTER, TINY
from .motion import RecordedJoint, Samples

NEAR_LIMIT = GAIN_MARGIN
"""Share of a joint's range within which it is at its limit."""

AGAIN = 2
"""Times beyond which it is no chance that a joint stands at one end of its motion: twice is one in
four."""

POWERLESS = 0.15
"""Share of the usual effort below which a motor doesn't drive its joint: the friction of geared
hobby servos without load is a tenth of their torque."""

PUSHES = 1.5
"""Times the usual effort from which a motor pushes against something: of a sine the mean size is
2/pi of the largest, so a motor at its limit gives 1.6."""


def standing_kinds(
    motion: RecordedJoint, spans: Sequence[Span], like: Sequence[RecordedJoint]
) -> tuple[tuple[str, ...], str]:
    """Return the kinds that fit a joint that stands still, and what decides.

    Args:
        spans: When it stands [s].
        like: Joints that its effort is compared with, if its own at other times can't be.
    """
    inside = within(motion.position.t_s, spans)
    at_limit = ("at_limit",) if _at_limit(motion, inside, spans) else ()
    kinds = ["jammed", "dead", "frozen_sensor"]
    if not _repeats(motion.position, inside):
        kinds.remove("frozen_sensor")  # new noise in each sample: the sensor measures
    second = _moves(motion.reference, motion.command, spans)
    if second:
        return ("frozen_sensor",), "the second sensor moves"
    if second is False:
        kinds = [kind for kind in kinds if kind != "frozen_sensor"]
    velocity = _moves(motion.velocity, motion.command, spans, rate=True)
    if velocity and "frozen_sensor" in kinds:
        if "velocity" in motion.outside_loop:
            return ("frozen_sensor",), "the velocity goes on"
        # A motor turns on behind a broken gear, too.
        return (*at_limit, "frozen_sensor", "dead"), "its velocity goes on"
    kinds, why = _by_effort(motion, spans, like, kinds)
    return (*at_limit, *kinds), why


def _by_effort(
    motion: RecordedJoint, spans: Sequence[Span], like: Sequence[RecordedJoint], kinds: list[str]
) -> tuple[list[str], str]:
    """Return the kinds that the effort leaves of those that fit, and what decides."""
    size = _effort(motion, spans, like)
    if size is None:
        return kinds, ""
    if size < POWERLESS:
        return ["dead"], f"its effort is {100 * size:.0f} % of the usual one"
    if motion.effort is not None and _repeats(motion.effort, within(motion.effort.t_s, spans)):
        return [*kinds, "stale_sensor"], "its effort repeats one value, too"
    driven = [kind for kind in kinds if kind != "dead"]
    if _is_constant(motion.effort, spans):
        driven = ["stalled", *driven]
    if "effort" in motion.outside_loop:
        pushes = size > PUSHES or "frozen_sensor" not in driven or "stalled" in driven
        driven = [kind for kind in driven if (kind == "frozen_sensor") is not pushes]
    return driven or kinds, f"its effort is {size:.1f} times the usual one"


def opposite_kinds(motion: RecordedJoint) -> tuple[tuple[str, ...], str]:
    """Return the kinds that fit a joint that moves against its command, and what decides."""
    t_s, position = motion.position.t_s, motion.position.values
    if motion.reference is not None and motion.reference.t_s.size > AGAIN:
        along = _correlation(motion.reference.at(t_s), position)
        if abs(along) > QUARTER:
            return (
                (("inverted_sensor",), "the second sensor moves with the command")
                if along < 0
                else (("inverted",), "the second sensor moves against the command, too")
            )
    if motion.velocity is not None and motion.velocity.t_s.size > AGAIN:
        rate = np.gradient(position, t_s)
        if _correlation(motion.velocity.at(t_s), rate) < -QUARTER:
            return ("inverted_sensor",), "its velocity has the opposite sign of its position"
    return ("inverted", "inverted_sensor"), ""


def within(t_s: FloatArray, spans: Sequence[Span]) -> BoolArray:
    """Mark the times, increasing, that lie in any span."""
    marked = np.zeros(t_s.size, dtype=np.bool_)
    for start, stop in spans:
        first, last = np.searchsorted(t_s, (start, stop))
        marked[first:last] = True
    return marked


def _repeats(samples: Samples, inside: BoolArray) -> bool:
    """Return whether most positions are, to the bit, the one before."""
    values = samples.values[inside]
    return values.size < 2 or 2 * int(np.count_nonzero(np.diff(values) == 0)) > values.size - 1


def _moves(
    samples: Samples | None, command: Samples, spans: Sequence[Span], *, rate: bool = False
) -> bool | None:
    """Return whether another quantity moves as commanded; None where it wasn't recorded."""
    if samples is None:
        return None
    parts: list[FloatArray] = []
    for span in spans:
        inside = within(samples.t_s, [span])
        if np.count_nonzero(inside) > AGAIN:
            t_s = samples.t_s[inside]
            asked = command.at(t_s)
            speed = np.gradient(asked, t_s)
            leading = speed, np.gradient(speed, t_s)
            rows = np.stack([samples.values[inside], *(leading if rate else (asked, speed))])
            parts.append(rows - rows.mean(axis=1, keepdims=True))
    if not parts:
        return None
    values, asked, lagging = np.concatenate(parts, axis=1)
    size = float(np.std(asked))
    if size == 0:
        return None
    design = np.stack([asked, lagging], axis=1)
    factors = np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)
    left: FloatArray = values - design @ factors
    explained = 1 - float(np.var(left)) / max(float(np.var(values)), TINY)
    return bool(np.std(values) > QUARTER * size and explained > HALF)


def _effort(
    motion: RecordedJoint, spans: Sequence[Span], like: Sequence[RecordedJoint]
) -> float | None:
    """Return the mean size of the effort while a joint stands, in the usual one.

    The usual one is that of the joints like it at the same times; of fewer than three, its own at
    other times.
    """
    here = _size(motion.effort, spans, inside=True)
    if here is None:
        return None
    others = [_size(other.effort, spans, inside=True) for other in like if other is not motion]
    sizes = [size for size in others if size is not None]
    usual = float(np.median(sizes)) if len(sizes) > AGAIN else None
    if usual is None:
        usual = _size(motion.effort, spans, inside=False)
    return here / usual if usual else None


def _is_constant(effort: Samples | None, spans: Sequence[Span]) -> bool:
    """Return whether an effort keeps one value."""
    if effort is None:
        return False
    values = effort.values[within(effort.t_s, spans)]
    level = float(np.median(values))
    return float(np.median(np.abs(values - level))) < NEAR_LIMIT * abs(level)


def _size(effort: Samples | None, spans: Sequence[Span], *, inside: bool) -> float | None:
    if effort is None:
        return None
    chosen = within(effort.t_s, spans)
    values = effort.values[chosen if inside else ~chosen]
    return float(np.mean(np.abs(values))) if values.size > AGAIN else None


def _at_limit(motion: RecordedJoint, inside: BoolArray, spans: Sequence[Span]) -> bool:
    """Return whether a joint stands at a limit, or again and again at one end of its motion."""
    values = motion.position.values
    if not inside.any():
        return False
    level = float(np.median(values[inside]))
    if motion.limits is not None:
        lower, upper = motion.limits
        slack = NEAR_LIMIT * (upper - lower)
        if level <= lower + slack or level >= upper - slack:
            return True
    levels = [values[within(motion.position.t_s, [span])] for span in spans]
    medians = [float(np.median(level)) for level in levels if level.size]
    slack = 2 * NEAR_LIMIT * motion.position.range
    low, high = float(values.min()), float(values.max())
    return len(medians) > AGAIN and (max(medians) <= low + slack or min(medians) >= high - slack)


def _correlation(first: FloatArray, second: FloatArray) -> float:
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])
