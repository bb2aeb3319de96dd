"""Artefacts of a joint's samples that are cheap to see and sure.

They are named beside the joint and kept apart from mechanics: a frozen encoder is not a weak
servo.
"""

from __future__ import annotations

import numpy as np

from capture.arrays import FloatArray

from .series import Series

AT_LIMIT_RAD = 1e-4
"""A position this close to its limit, or beyond it, is at the limit."""

AT_LIMIT_SHARE = 0.01
FROZEN_CYCLES = 0.25
STALE_SHARE = 0.2
GAP_SHARE = 0.01


def joint_flags(
    response: Series,
    command: Series | None,
    limits: tuple[float, float] | None,
    *,
    driven_hz: float | None,
    fraction_covered: float,
) -> tuple[str, ...]:
    """What is wrong with one joint's samples.

    Args:
        response: Its measured positions in the window [rad].
        command: Its commanded positions in the window [rad], or None.
        limits: Lower and upper joint limit [rad], or None where no robot description says.
        driven_hz: Gait frequency if the gait drives the joint [Hz], else None.
        fraction_covered: Fraction of the window that has samples.

    Returns:
        Of ``saturated``, ``frozen``, ``stale``, ``nan``, ``duplicate_stamps``, ``gaps``.
    """
    flags: list[str] = []
    if limits is not None:
        moves = (one for one in (response, command) if one is not None)
        if any(_at_limit(one.values, limits) for one in moves):
            flags.append("saturated")
    if driven_hz is not None:
        frozen = _longest_hold(response) > FROZEN_CYCLES / driven_hz
        if frozen:
            flags.append("frozen")
        elif _is_stale(response):
            flags.append("stale")
    if response.dropped_nan:
        flags.append("nan")
    if response.dropped_duplicates:
        flags.append("duplicate_stamps")
    if fraction_covered < 1 - GAP_SHARE:
        flags.append("gaps")
    return tuple(flags)


def _at_limit(values: FloatArray, limits: tuple[float, float]) -> bool:
    lower, upper = limits
    at = (values <= lower + AT_LIMIT_RAD) | (values >= upper - AT_LIMIT_RAD)
    return bool(values.size and np.mean(at) > AT_LIMIT_SHARE)


def _longest_hold(series: Series) -> float:
    """Longest time over which the value stays exactly the same [s]."""
    if series.count < 2:
        return 0.0
    changes = np.flatnonzero(np.diff(series.values) != 0) + 1
    first = np.concatenate(([0], changes))
    last = np.concatenate((changes, [series.count])) - 1
    return float(np.max(series.t_s[last] - series.t_s[first]))


def _is_stale(series: Series) -> bool:
    """Whether samples repeat although the joint must have moved on by more than it resolves.

    Looked at where the motion is fast: where the change over four samples is more than half of
    its largest, and more than eight times the smallest step the sensor ever shows.
    """
    step = np.abs(np.diff(series.values)).astype(np.float64)
    if step.size < 16:
        return False
    moved = step[step > 0]
    resolution = float(moved.min()) if moved.size else np.inf
    travel = np.abs(series.values[4:] - series.values[:-4])
    fast = (travel > 0.5 * travel.max()) & (travel > 8 * resolution)
    repeats = (step == 0)[1:-2]
    return bool(np.count_nonzero(repeats & fast) > STALE_SHARE * np.count_nonzero(fast))
