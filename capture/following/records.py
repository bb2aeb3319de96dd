"""What a record of positions lacks: lost samples and repeated old values, joint against joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import bdtrc

from ..common.threads import in_threads
from .fault import Span, Symptom
from .motion import JointMotion, Samples

LOST_SHARE = 0.01
"""Share of a joint's samples that may be missing beyond what the joints have in common."""

STALE_SHARE = 0.15
"""Share of the fast samples that may repeat the one before, beyond what all joints do."""

WRAP = 5.0
"""A step so many times as large as the command's largest is no motion."""

SAME_TURN = 0.1
"""Steps of one counter differ by less than this, relative."""

TURNS = (2 * np.pi, 4 * np.pi, np.pi, 300 * np.pi / 180, 360.0, 4096.0, 65536.0)
"""Turns of counters: of a shaft, of half and double shafts, of a servo's range, in raw units."""

MOSTLY = 0.8

SILENT = 0.02
"""A gap longer than this share of the record is a silence."""

RARE = 1e-6
"""Chance of so many repeats by which a joint of many sessions is taken to repeat old values."""

LONGEST = 8
"""More repeats in turn than this are a joint that stands or a sensor that froze, not old values."""

GAP = 1.8
"""An interval of so many median ones lacks a sample."""

FAST = 0.5
"""Fast samples: the joint moves more than this share of its usual fast step."""

AROUND = 4
"""Samples on either side over which its motion is taken."""

SPIKE = 8.0
"""Robust standard deviations of the noise about the running median that make a spike."""

SPIKE_STEPS = 3.0
"""A spike is also larger than so many of the command's largest steps: the median may be late."""

SPIKE_SHARE = 0.1
"""A spike is also larger than this share of the command's range."""

SPIKES = 0.003
"""Share of the samples that may be spikes beyond what the joints have in common."""


def record_faults(motions: Sequence[JointMotion]) -> dict[str, list[Symptom]]:
    """Find joints whose positions are missing or repeated more than the others'.

    Args:
        motions: All joints.

    Returns:
        Joint name to symptoms; only joints that have some.
    """
    sampled = [each for each in motions if each.position.t_s.size > 2]
    result: dict[str, list[Symptom]] = {}
    largest = max((each.command.range for each in sampled), default=0.0)

    def counts(each: JointMotion) -> tuple[float, int, int, float]:
        moves = each.command.range > SPIKE_SHARE * largest
        return _lost(each), *_repeats(each), _spikes(each) if moves else 0.0

    found = in_threads(counts, sampled, sum(each.position.t_s.size for each in sampled))
    usual_lost = float(np.median([lost for lost, *_ in found] or [0.0]))
    usual_stale = float(np.median([again / of for _, again, of, _ in found if of] or [0.0]))
    usual_spikes = float(np.median([spiky for *_, spiky in found] or [0.0]))
    expected = min(STALE_SHARE + 2 * usual_stale, 1.0)
    for each, (missing, again, fast, spiky) in zip(sampled, found, strict=True):
        symptoms: list[Symptom] = []
        if spiky > SPIKES + 2 * usual_spikes:
            text = f"{100 * spiky:.2g} % of its samples are far from those around them"
            symptoms.append(Symptom("noisy", (), text))
        if missing > LOST_SHARE + 2 * usual_lost:
            text = f"{100 * missing:.2g} % of its samples missing"
            symptoms.append(Symptom("lost", _silences(each, missing), text))
        if bdtrc(again - 1, fast, expected) < RARE:
            text = f"{100 * again / fast:.2g} % of its fast samples repeat the one before"
            symptoms.append(Symptom("stale", (), text))
        if symptoms:
            result[each.name] = symptoms
    for each in motions:
        if each.position.t_s.size <= 2 < each.command.t_s.size and sampled:
            result[each.name] = [Symptom("lost", (), "no position was recorded")]
    return result


def wraps(each: JointMotion) -> Symptom | None:
    """Find the steps of a counter that wraps around.

    Args:
        each: The joint.

    Returns:
        The symptom, if steps of one size, both up and down or again and again, are larger than
        the command ever moves between two samples and larger than half of its range.
    """
    samples = each.position
    if samples.t_s.size < 16:
        return None
    step = np.diff(samples.values)
    large = np.abs(step) > max(WRAP * each.largest_step, 0.5 * each.command.range)
    sizes = np.abs(step[large])
    if not 2 <= sizes.size <= 0.2 * step.size:
        return None
    turn = float(np.median(sizes))
    near = np.abs(sizes / turn - 1) < SAME_TURN
    known = min(abs(turn / size - 1) for size in TURNS) < SAME_TURN
    if np.mean(near) < MOSTLY or not known:
        return None
    # A counter that wraps comes back: up and down steps cancel but for one.
    balance = abs(float(np.sum(np.sign(step[large]))))
    if balance > max(1.0, 0.2 * sizes.size):
        return None
    return Symptom("wrapped", (), f"{sizes.size} steps of {np.degrees(turn):.0f} degrees")


def _lost(each: JointMotion) -> float:
    """Share of the samples that are missing or not finite."""
    samples = each.position
    step = np.diff(samples.t_s)
    usual = samples.period_s
    gaps = step[step > GAP * usual]
    absent = float(np.sum(np.round(gaps / usual) - 1)) if gaps.size else 0.0
    # A record of one message per servo may end early: what lacks at the ends counts, too.
    edges = max(0.0, samples.t_s[0] - each.command.t_s[0]) if each.command.t_s.size else 0.0
    edges += max(0.0, each.command.t_s[-1] - samples.t_s[-1]) if each.command.t_s.size else 0.0
    absent += max(0.0, edges / usual - 2.0)
    return absent / (samples.t_s.size + absent)


def _spikes(each: JointMotion) -> float:
    """Share of the samples that lie alone, far from the running median of five."""
    values = each.position.values
    if values.size < 4 * AROUND:
        return 0.0
    away = np.abs(values - median_filter(values, size=5, mode="nearest"))
    noise = 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / 6**0.5
    far = away > max(
        SPIKE * noise, SPIKE_STEPS * each.largest_step, SPIKE_SHARE * each.command.range
    )
    return float(np.count_nonzero(far)) / values.size


def _silences(each: JointMotion, missing: float) -> tuple[Span, ...]:
    """The gaps, where a few long ones hold most of what is missing; else none."""
    t_s = each.position.t_s
    step = np.diff(t_s)
    length = float(t_s[-1] - t_s[0])
    long = np.flatnonzero(step > SILENT * length)
    if not long.size or float(step[long].sum()) < MOSTLY * missing * length:
        return ()
    return tuple(zip(t_s[long].tolist(), t_s[long + 1].tolist(), strict=True))


def _repeats(each: JointMotion) -> tuple[int, int]:
    """How many samples during fast motion repeat the one before, and of how many."""
    samples: Samples = each.position
    values = samples.values
    step = np.abs(np.diff(values))
    moved = step[step > 0]
    if moved.size < 10 or values.size < 4 * AROUND:
        return 0, 0
    # Its own motion over a few samples: a joint that stands repeats its values rightly.
    travel = np.abs(values[2 * AROUND :] - values[: -2 * AROUND]) / (2 * AROUND)
    travel = np.pad(travel, (AROUND, AROUND - 1), mode="edge")
    fast = travel > max(2 * float(moved.min()), FAST * float(np.percentile(travel, 95)))
    if np.count_nonzero(fast) < 20:
        return 0, 0
    repeated = step == 0
    # A joint that stands repeats, too, and for longer.
    edges = np.flatnonzero(np.diff(np.concatenate(([False], repeated, [False])).astype(np.int8)))
    for first, stop in edges.reshape(-1, 2).tolist():
        if stop - first > LONGEST:
            repeated[first:stop] = False
    return int(np.count_nonzero(fast & repeated)), int(np.count_nonzero(fast))
