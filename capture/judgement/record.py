"""Faults of a joint's record: samples that are missing, repeated, or off by a counter's turns.

Each is counted beyond what the joints of the session have in common.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import bdtrc

from ..common.arrays import FloatArray
from ..common.process import in_threads
from .fault import Fault, Span
from .levels import (
    COVERAGE,
    FEWEST,
    FOLLOWS,
    FULL,
    GAIN_MARGIN,
    NEGLIGIBLE,
    RARE,
)
from .motion import RecordedJoint

STALE = 0.15
"""Share of the fast samples that may repeat the one before, beyond what all joints do: a bus that
is read faster than its servos answer."""


FEW = 1 - FOLLOWS
"""Share of the samples that may be steps of a counter, and largest step of the command in one."""


def record_faults(motions: Sequence[RecordedJoint]) -> dict[str, Fault]:
    """Find joints whose positions are missing, repeated or off by turns, by name."""
    sampled = [motion for motion in motions if motion.position.t_s.size > 2]

    def counts(motion: RecordedJoint) -> tuple[float, int, int, str]:
        return _lost(motion), *_repeats(motion), _wraps(motion)

    total = sum(motion.position.t_s.size for motion in sampled)
    counted = in_threads(counts, sampled, total)
    usual_lost = float(np.median([lost for lost, *_ in counted] or [0.0]))
    usual_stale = float(np.median([repeats / of for _, repeats, of, _ in counted if of] or [0.0]))
    expected = min(STALE + 2 * usual_stale, 1.0)
    faults: dict[str, Fault] = {}
    for motion, (missing, repeats, fast, wrapped) in zip(sampled, counted, strict=True):
        name = motion.name
        if wrapped:
            faults[name] = _whole(name, ("wrapped_sensor",), wrapped)
        elif bdtrc(repeats - 1, fast, expected) < RARE:
            text = f"{100 * repeats / fast:.2g} % of its fast samples repeat the one before"
            faults[name] = _whole(name, ("stale_sensor", "lost_samples"), text)
        elif missing > NEGLIGIBLE + 2 * usual_lost:
            text = f"lacks samples, {100 * missing:.2g} % of its samples missing"
            faults[name] = _whole(name, ("lost_samples",), text, _silences(motion, missing))
    for motion in motions:
        if motion.position.t_s.size <= 2 < motion.command.t_s.size and sampled:
            text = "lacks samples, no position was recorded"
            faults[motion.name] = _whole(motion.name, ("lost_samples",), text)
    return faults


def _whole(name: str, kinds: tuple[str, ...], text: str, spans: tuple[Span, ...] = ()) -> Fault:
    since, until = (spans[0][0], spans[-1][1]) if spans else (None, None)
    return Fault(name, kinds, spans, since, until, 1.0, text)


def _lost(motion: RecordedJoint) -> float:
    """Share of the samples that are missing or not finite."""
    samples = motion.position
    step, usual = np.diff(samples.t_s), samples.period_s
    gaps = step[step > (1 + FOLLOWS) * usual]  # jitter of 80 % is none
    absent = float(np.sum(np.round(gaps / usual) - 1)) if gaps.size else 0.0
    # A record of one message per servo may end early: what lacks at the ends counts, too.
    if (commanded := motion.command.t_s).size:
        edges = max(0.0, samples.t_s[0] - commanded[0]) + max(0.0, commanded[-1] - samples.t_s[-1])
        absent += max(0.0, edges / usual - 2)
    return absent / (samples.t_s.size + absent)


def _silences(motion: RecordedJoint, missing: float) -> tuple[Span, ...]:
    """Return the gaps if a few long ones hold most missing samples; else none."""
    t_s = motion.position.t_s
    step = np.diff(t_s)
    length = float(t_s[-1] - t_s[0])
    long = np.flatnonzero(step > GAIN_MARGIN * length)
    if not long.size or float(step[long].sum()) < FOLLOWS * missing * length:
        return ()
    return tuple(zip(t_s[long].tolist(), t_s[long + 1].tolist(), strict=True))


def _repeats(motion: RecordedJoint) -> tuple[int, int]:
    """Count the samples during fast motion that repeat the one before, and all of them."""
    values = motion.position.values
    step = np.abs(np.diff(values))
    moved = step[step > 0]
    half = FEWEST // 2
    if moved.size < FEWEST or values.size < 2 * FEWEST:
        return 0, 0
    # Its own motion over a few samples: a joint that stands repeats its values rightly.
    travel = np.abs(values[FEWEST:] - values[:-FEWEST]) / FEWEST
    travel = np.pad(travel, (half, half - 1), mode="edge")
    fast = travel > np.maximum(2 * moved.min(), np.quantile(travel, COVERAGE) / 2)
    repeated = step == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], repeated.astype(np.int8), [0]])))
    for first, stop in edges.reshape(-1, 2).tolist():
        if stop - first > FEWEST:
            repeated[first:stop] = False
    return int(np.count_nonzero(fast & repeated)), int(np.count_nonzero(fast))


def _wraps(motion: RecordedJoint) -> str:
    """Describe the steps of a counter that wraps around, if there are such.

    They have one size, within which the joint stays, go up and down, and are larger than the
    command ever moves between two samples and than half of its range.
    """
    samples = motion.position
    step = np.diff(samples.values)
    asked = np.abs(np.diff(motion.command.at(samples.t_s)))
    largest = float(asked.max()) if asked.size else 0.0
    large: FloatArray = step[np.abs(step) > max(largest / FEW, motion.command.range / 2)]
    if not 2 <= large.size <= step.size * FEW:
        return ""
    turn = float(np.median(np.abs(large)))
    # A counter wraps after half a turn of a shaft at least, and stays within one turn of its own.
    confined = FULL * max(np.pi, samples.range) < turn
    near = np.abs(np.abs(large) / turn - 1) < 1 - FULL
    balance = abs(float(np.sum(np.sign(large))))
    if not confined or np.mean(near) < FOLLOWS or balance > max(1.0, large.size * FEW):
        return ""
    return f"{large.size} steps of {np.degrees(turn):.0f} degrees"
