"""From the reversal test to a result: the pairs that differ, bounds, shares of the spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ...estimators.equivalence import EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD, equivalence_p
from ...estimators.intervals import around
from ...results.estimate import Estimate
from ...results.experiment import FloorTilt, Headings, MirrorJoint, OrderedPair, Reversal
from .mirror import MirrorTest, mirror_test
from .shares import variance_shares
from .tilt import heading_strata, tilt_check

SIGNIFICANT = 0.05
"""Family-wise level of the whole result: one family of the contrasts and the common parts of all
pairs, gain and lag, gives the p of H1 and that of each pair."""

SAME_HEADING_RAD = 0.2
"""Headings that differ by no more are the same [rad]: 2 % of a tilt along the body is left."""


def reversal_of(
    names: Sequence[str],
    forward: ComplexArray,
    reverse: ComplexArray,
    headings: tuple[FloatArray, FloatArray] | None = None,
    gravity_rad: Estimate | None = None,
) -> Reversal:
    """Test identical modules, order the pairs that differ, and split the spread.

    Args:
        names: Of m joints, head to tail.
        forward: y = ln(response/command) of the runs with the wave from head to tail, (r1, m).
        reverse: y of the runs from tail to head, shape (r2, m), joints from head to tail too.
        headings: Of the robot in each run of either way [rad], NaN where it is unknown, shapes
            (r1,) and (r2,); None where none is known.
        gravity_rad: Lean of the body along itself by recorded gravity, None where none is
            recorded.

    Returns:
        The result.

    Raises:
        UsageError: If a way has fewer than two runs.
    """
    known = headings or (np.full(len(forward), np.nan), np.full(len(reverse), np.nan))
    strata = heading_strata(*known, SAME_HEADING_RAD)
    test = mirror_test(forward, reverse, strata)
    shares = variance_shares(forward, reverse)
    half = test.critical * test.error
    bounds = (np.abs([test.difference.real, test.difference.imag]) + half).max(axis=1)
    if strata is not None:
        kind = Headings.BALANCED
    else:
        every = all(np.isfinite(one).all() for one in known)
        kind = Headings.UNBALANCED if every else Headings.UNKNOWN
    check = tilt_check(forward, reverse, test, gravity_rad)
    return Reversal(
        forward_runs=len(forward),
        reverse_runs=len(reverse),
        statistic=test.statistic,
        p=test.p,
        p_floor=test.floor,
        labellings=test.labellings,
        labellings_tried=test.tried,
        joints=_joints(names, test),
        pairs=ordered_pairs(names, test),
        gain_bound=float(np.expm1(bounds[0])),
        lag_bound_rad=float(bounds[1]),
        equivalence_gain_p=equivalence_p(
            test.difference.real, test.error[0], test.dof[0], EQUIVALENT_GAIN
        ),
        equivalence_lag_p=equivalence_p(
            test.difference.imag, test.error[1], test.dof[1], EQUIVALENT_LAG_RAD
        ),
        module_variance=shares.module_variance,
        boundary_variance=shares.boundary_variance,
        noise_variance=shares.noise_variance,
        module_share=shares.module_share,
        boundary_share=shares.boundary_share,
        tilt=FloorTilt(
            headings=kind,
            strata=test.strata,
            ratio=check.ratio,
            middle=check.middle,
            gravity_rad=gravity_rad or Estimate(),
            excluded=kind is Headings.BALANCED or check.excluded,
        ),
        middle=names[len(names) // 2] if len(names) % 2 else None,
    )


def ordered_pairs(names: Sequence[str], test: MirrorTest) -> tuple[OrderedPair, ...]:
    """Order the joints of each mirror pair that differs beyond doubt.

    The joint that answers less has less gain or more lag, whichever the pair's contrast shows more
    clearly. Whether it is weak or its mirror joint strong, no contrast decides.

    Args:
        names: Of m joints, head to tail.
        test: Of the same joints.

    Returns:
        The largest contrast first: a module changes what its neighbours do, but less.
    """
    m = len(names)
    pairs: list[tuple[float, OrderedPair]] = []
    for i in range(m // 2):
        if test.pair_p[i] >= SIGNIFICANT:
            continue
        seen = np.array([test.contrast[i].real, test.contrast[i].imag])
        clear = np.abs(seen) / np.maximum(test.contrast_error[:, i], np.finfo(np.float64).tiny)
        part = int(np.argmax(clear))
        # Less gain and more lag are both a negative part of ln H.
        k = i if seen[part] < 0 else m - 1 - i
        gain, lag = _estimates(test.contrast[k], test.critical * test.contrast_error[:, k])
        by = ("gain", "lag")[part]
        pair = OrderedPair(names[k], names[m - 1 - k], by, gain, lag, float(test.pair_p[i]))
        pairs.append((abs(test.contrast[i]), pair))
    pairs.sort(key=lambda each: each[0], reverse=True)
    return tuple(pair for _, pair in pairs)


def _joints(names: Sequence[str], test: MirrorTest) -> tuple[MirrorJoint, ...]:
    own = test.joint_p
    result: list[MirrorJoint] = []
    for i, name in enumerate(names):
        gain, lag = _estimates(test.difference[i], test.critical * test.error[:, i])
        result.append(MirrorJoint(name, names[-1 - i], gain, lag, float(own[i])))
    return tuple(result)


def _estimates(value: complex, half: FloatArray) -> tuple[Estimate, Estimate]:
    """Log gain and lag, positive when late, with their half widths."""
    gain, lag = float(value.real), -float(value.imag)
    return (
        Estimate(gain, around(gain, float(half[0]))),
        Estimate(lag, around(lag, float(half[1]))),
    )
