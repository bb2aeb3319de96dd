"""What a record of positions lacks: lost samples and repeated old values, joint against joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .kinds import Symptom
from .motion import JointMotion, Samples

LOST_SHARE = 0.01
"""Share of a joint's samples that may be missing beyond what the joints have in common."""

STALE_SHARE = 0.1
"""Share of the fast samples that may repeat the one before, beyond what all joints do."""

GAP = 1.8
"""An interval of so many median ones lacks a sample."""

FAST = 0.5
"""Fast samples: the command moves more than this share of its usual fast step."""


def record_faults(motions: Sequence[JointMotion]) -> dict[str, list[Symptom]]:
    """Find joints whose positions are missing or repeated more than the others'.

    Args:
        motions: All joints.

    Returns:
        Joint name to symptoms; only joints that have some.
    """
    sampled = [each for each in motions if each.position.t_s.size > 2]
    result: dict[str, list[Symptom]] = {}
    lost = [_lost(each) for each in sampled]
    stale = [_repeats(each) for each in sampled]
    usual_lost = float(np.median(lost)) if lost else 0.0
    usual_stale = float(np.median(stale)) if stale else 0.0
    for each, missing, repeated in zip(sampled, lost, stale, strict=True):
        symptoms: list[Symptom] = []
        if missing > LOST_SHARE + 2 * usual_lost:
            symptoms.append(Symptom("lost", (), f"{100 * missing:.2g} % of its samples missing"))
        if repeated > STALE_SHARE + 2 * usual_stale:
            text = f"{100 * repeated:.2g} % of its samples repeat the one before"
            symptoms.append(Symptom("stale", (), text))
        if symptoms:
            result[each.name] = symptoms
    for each in motions:
        if each.position.t_s.size <= 2 < each.command.t_s.size and sampled:
            result[each.name] = [Symptom("lost", (), "no position was recorded")]
    return result


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


def _repeats(each: JointMotion) -> float:
    """Share of the samples during fast motion that repeat the one before."""
    samples: Samples = each.position
    expected = np.abs(np.diff(each.command.at(samples.t_s))) if each.command.t_s.size > 1 else None
    step = np.abs(np.diff(samples.values))
    moved = step[step > 0]
    if expected is None or moved.size < 10:
        return 0.0
    least = max(2 * float(moved.min()), FAST * float(np.percentile(expected, 95)))
    fast = expected > least
    if np.count_nonzero(fast) < 20:
        return 0.0
    return float(np.count_nonzero(fast & (step == 0)) / np.count_nonzero(fast))
