"""From the reversal test to a result: the pairs that differ, bounds, shares of the spread.

How much of the spread over the joints is the boundary's, and how much the modules' own.

With y_i(+) = b_i + delta_i and y_i(-) = b_{m+1-i} + delta_i, where b is what identical modules do
and delta_i is module i's own (independent of its mirror joint's, with variance V_module), the
mirrored difference is d_i = delta_i - delta_{m+1-i}, so::

    V_module   = 2 max(0, mean |d / 2|^2 - noise)
    V_boundary = V_total - V_module - noise

|.|^2 adds log gain and lag [rad], which weigh alike in the complex response. The middle joint of
an odd number is its own mirror joint and left out of V_module.

Could a tilted floor make what looks like a module? Three checks that need no model.

On a floor that falls by s along the body, identical modules answer y_i(+, s) = b_i + s g_i, and by
the mirror image y_{m+1-i}(-, s) = b_i - s g_i: with one heading only, d_i = 2 s g_i is no module's.
It differs from one bad module in three ways:

- Gravity pulls on the whole body. The joints of a pair change alike when the wave turns round, so
  the common part (d_i + d_{m+1-i}) / 2 outweighs the contrast (d_i - d_{m+1-i}) / 2 over the body;
  for one module, at its joint, contrast outweighs what is common.
- The middle joint of an odd number is its own mirror joint. A module elsewhere changes it little,
  a tilt as much as the others.
- Recorded gravity leans: by more than 0.1 degrees, since the motion itself and the sensor's mount
  make some hundredths. That it doesn't lean excludes nothing: an offset may hide it.

The first two are statements about the size of effects, not theorems: measured on the twin in
docs/explanation/heterogeneity.md. Runs with the robot turned by half a turn
(:mod:`.reversal.mirror`) need none of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from ..common.estimate import Estimate, Interval
from ..estimators.intervals import (
    CONFIDENCE,
    EQUIVALENT_GAIN,
    EQUIVALENT_LAG_RAD,
    around,
    equivalence_p,
    t_factor,
)
from ..results.experiment import FloorTilt, Headings, MirrorJoint, OrderedPair, Reversal
from .mirror import MirrorTest, mirror_test

MODULE_RATIO = 1.0
"""Common over contrast below which the pattern is a module's rather than a tilt's."""

LEVEL_RAD = math.radians(0.1)
"""Lean of recorded gravity that the motion itself may make."""

LEAST_LEANS = 3
"""Runs with recorded gravity below which its scatter is unknown."""

RESAMPLES = 2_000

SIGNIFICANT = 0.05
"""Family-wise level of the whole result: one family of the contrasts and the common parts of all
pairs, gain and lag, gives the p of H1 and that of each pair."""

SAME_HEADING_RAD = 0.2
"""Headings that differ by no more are the same [rad]: 2 % of a tilt along the body is left."""


def tilt_check(
    forward: ComplexArray,
    reverse: ComplexArray,
    test: MirrorTest,
    gravity_rad: Estimate | None = None,
    headings: Headings = Headings.UNKNOWN,
) -> FloorTilt:
    """Check whether a tilted floor can make the differences of a reversal.

    Args:
        forward: y of the runs one way, shape (r1, m).
        reverse: y of the runs the other way, shape (r2, m), joints from head to tail too.
        gravity_rad: Lean of recorded gravity along the body with its interval, None or empty where
            none is recorded.
        headings: Balanced ones exclude a tilt by design.
    """
    ratio = common_ratio(forward, reverse)
    excluded = ratio.ci95 is not None and ratio.ci95[1] < MODULE_RATIO
    middle = None
    if len(test.difference) % 2:
        middle = _middle_share(test)
        excluded &= middle is not None and middle < 1.0
    gravity_rad = gravity_rad or Estimate()
    lean = gravity_rad.ci95
    excluded &= lean is None or (lean[0] < LEVEL_RAD and lean[1] > -LEVEL_RAD)
    excluded |= headings is Headings.BALANCED
    return FloorTilt(headings, test.strata, ratio, middle, gravity_rad, excluded)


def floor_lean(lean_rad: FloatArray, heading_rad: FloatArray) -> Estimate:
    """Return the fall of the floor along the body by recorded gravity.

    Args:
        lean_rad: Of each run [rad], NaN where none is recorded, shape (r,).
        heading_rad: Of the robot in each run [rad], NaN where it is unknown, shape (r,).

    Returns:
        The fall along the first run's heading with its interval over the runs; where the headings
        differ by half a turn the sensor's own offset is taken out. Empty with fewer than three
        runs.
    """
    recorded = np.isfinite(lean_rad)
    lean, heading = lean_rad[recorded], heading_rad[recorded]
    along = np.ones_like(lean)
    columns = [along]
    if np.isfinite(heading).all() and heading.size:
        along = np.cos(heading - heading[0])
        columns = [along, np.ones_like(lean)] if np.ptp(along) > 1.0 else [along]
    design = np.stack(columns, axis=1)
    dof = len(lean) - design.shape[1]
    if dof < 1 or len(lean) < LEAST_LEANS:
        return Estimate()
    value = np.linalg.lstsq(design, lean, rcond=None)[0]
    variance = np.sum((lean - design @ value) ** 2) / dof
    error = float(np.sqrt(variance * np.linalg.inv(design.T @ design)[0, 0]))
    return Estimate(float(value[0]), around(float(value[0]), t_factor(dof) * error))


def common_ratio(forward: ComplexArray, reverse: ComplexArray) -> Estimate:
    """Return the RMS of the common part of d over that of the contrast, noise subtracted.

    Args:
        forward: y of the runs one way, shape (r1, m).
        reverse: y of the runs the other way, shape (r2, m).

    Returns:
        The ratio with its percentile interval from a bootstrap over runs, each way resampled for
        itself; empty where the contrast is no more than noise.
    """
    random = np.random.default_rng(1)
    noise = np.zeros(2)
    means: list[ComplexArray] = []
    drawn: list[ComplexArray] = []
    for runs in (forward, reverse[:, ::-1]):
        parity = np.stack([runs + runs[:, ::-1], runs - runs[:, ::-1]]) / 2
        noise += parity.var(axis=1, ddof=1).sum(axis=-1) / len(runs)
        means.append(parity.mean(axis=1))
        drawn.append(_resampled(parity, random))
    power = np.sum(np.abs(means[0] - means[1]) ** 2, axis=-1) - noise
    if power[1] <= 0:
        return Estimate()
    # The bootstrap adds the noise once more, which is subtracted once more.
    powers = np.sum(np.abs(drawn[0] - drawn[1]) ** 2, axis=-1) - 2 * noise[:, None]
    ratios = np.sqrt(np.maximum(powers[0], 0.0) / np.maximum(powers[1], np.finfo(np.float64).tiny))
    return Estimate(float(np.sqrt(max(power[0], 0.0) / power[1])), _percentiles(ratios))


def heading_strata(forward: FloatArray, reverse: FloatArray) -> tuple[IntArray, IntArray] | None:
    """Find strata of runs that are mirror images of each other, by the robot's headings.

    Args:
        forward: Heading of each run one way [rad], NaN where it is unknown, shape (r1,).
        reverse: The same the other way, shape (r2,).

    Returns:
        Stratum of each run of either way, or None where a heading is unknown or a stratum lacks
        two runs of a way.
    """
    # A reversed wave is the mirror image of a wave of a robot that is turned by half a turn.
    keys = np.concatenate([forward, reverse + np.pi])
    if not np.isfinite(keys).all():
        return None
    leaders: list[float] = []
    index = np.zeros(len(keys), dtype=np.int64)
    for k, key in enumerate(keys.tolist()):
        apart = np.abs(np.angle(np.exp(1j * (key - np.array(leaders)))))
        near = np.flatnonzero(apart <= SAME_HEADING_RAD)
        index[k] = near[0] if near.size else len(leaders)
        if not near.size:
            leaders.append(key)
    plus = np.bincount(index[: len(forward)], minlength=len(leaders))
    minus = np.bincount(index[len(forward) :], minlength=len(leaders))
    if min(plus.min(), minus.min()) < 2:
        return None
    return index[: len(forward)], index[len(forward) :]


def _middle_share(test: MirrorTest) -> float | None:
    """Return the middle joint's upper bound over the largest contrast's lower bound."""
    k = len(test.difference) // 2
    contrast = np.abs(np.stack([test.contrast.real, test.contrast.imag]))
    least = float((contrast - test.critical * test.contrast_error).max())
    middle = np.abs([test.difference[k].real, test.difference[k].imag])
    most = float((middle + test.critical * test.error[:, k]).max())
    return most / least if least > 0 else None


@dataclass(frozen=True)
class Shares:
    """Where the spread of the response over the joints comes from.

    Attributes:
        module_variance: V_module, of log gain plus lag [1 = rad^2], with interval.
        boundary_variance: V_boundary, never below zero, with interval.
        noise_variance: What noise adds to V_total.
        module_share: V_module / (V_module + V_boundary) with interval; empty where noise explains
            all of the spread.
        boundary_share: The rest, with interval.
    """

    module_variance: Estimate
    boundary_variance: Estimate
    noise_variance: float
    module_share: Estimate
    boundary_share: Estimate


def variance_shares(forward: ComplexArray, reverse: ComplexArray) -> Shares:
    """Split the spread over the joints.

    Args:
        forward: y of the runs one way, shape (r1, m), m >= 2, r1 >= 2.
        reverse: y of the runs the other way, shape (r2, m), r2 >= 2.

    Returns:
        The shares. Intervals by bootstrap over runs, each way resampled for itself; a resample
        adds the noise once more, which is subtracted once more.
    """
    mirrored = reverse[:, ::-1]
    random = np.random.default_rng(1)
    noise = np.stack([_noise(forward), _noise(mirrored)])
    module, boundary = _variances(np.stack([forward.mean(axis=0), mirrored.mean(axis=0)]), noise)
    drawn = np.stack([_resampled(runs, random) for runs in (forward, mirrored)])
    modules, boundaries = _variances(drawn, 2 * noise)
    whole, wholes = module + boundary, modules + boundaries
    share = rest = Estimate()
    if whole > 0:
        value, some = float(module / whole), wholes > 0
        share = Estimate(value)
        if some.any():
            low, high = _percentiles(modules[some] / wholes[some])
            share, rest = Estimate(value, (low, high)), Estimate(1 - value, (1 - high, 1 - low))
    return Shares(
        module_variance=Estimate(float(module), _percentiles(modules)),
        boundary_variance=Estimate(float(boundary), _percentiles(boundaries)),
        noise_variance=float(noise.mean()),
        module_share=share,
        boundary_share=rest,
    )


def _variances(means: ComplexArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return V_module and V_boundary of both ways' profiles (2, ..., m), the reverse mirrored."""
    joint: IntArray = np.arange(means.shape[-1], dtype=np.int64)
    paired: BoolArray = joint != joint[::-1]
    half: FloatArray = np.abs((means[0] - means[1]) / 2)[..., paired] ** 2
    excess = half.mean(axis=-1) - noise.sum(axis=0)[paired].mean() / 4
    module: FloatArray = 2 * np.maximum(0.0, excess)
    total: FloatArray = np.var(means, axis=-1, ddof=1).mean(axis=0)
    return module, np.maximum(0.0, total - module - noise.mean())


def _noise(runs: ComplexArray) -> FloatArray:
    """Return the variance of the mean of r runs, gain and lag together, shape (m,)."""
    return np.var(runs, axis=0, ddof=1) / len(runs)


def _resampled(runs: ComplexArray, random: np.random.Generator) -> ComplexArray:
    """Return means of resampled runs, (..., r, m) -> (..., RESAMPLES, m).

    A resample of r runs scatters by (r - 1)/r too little, which is corrected.
    """
    r = runs.shape[-2]
    weights = random.multinomial(r, np.full(r, 1 / r), size=RESAMPLES) / r
    mean = runs.mean(axis=-2, keepdims=True)
    return mean + (r / (r - 1)) ** 0.5 * (weights @ (runs - mean))


def _percentiles(values: FloatArray) -> Interval:
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)


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

    Raises:
        UsageError: If a way has fewer than two runs.
    """
    recorded = headings or (np.full(len(forward), np.nan), np.full(len(reverse), np.nan))
    strata = heading_strata(*recorded)
    test = mirror_test(forward, reverse, strata)
    half = test.critical * test.error
    bounds = (np.abs([test.difference.real, test.difference.imag]) + half).max(axis=1)
    kind = (
        Headings.UNBALANCED
        if all(np.isfinite(heading).all() for heading in recorded)
        else Headings.UNKNOWN
    )
    if strata is not None:
        kind = Headings.BALANCED
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
        **vars(variance_shares(forward, reverse)),
        tilt=tilt_check(forward, reverse, test, gravity_rad, kind),
        middle=names[len(names) // 2] if len(names) % 2 else None,
    )


def ordered_pairs(names: Sequence[str], test: MirrorTest) -> tuple[OrderedPair, ...]:
    """Order the joints of each mirror pair that differs beyond doubt.

    The joint that answers less has less gain or more lag, whichever the pair's contrast shows more
    clearly. Whether it is weak or its mirror joint strong, no contrast decides.

    Args:
        names: Of m joints, head to tail.

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
    pairs.sort(key=lambda ranked: ranked[0], reverse=True)
    return tuple(pair for _, pair in pairs)


def _joints(names: Sequence[str], test: MirrorTest) -> tuple[MirrorJoint, ...]:
    joint_p = test.joint_p
    half = test.critical * test.error
    return tuple(
        MirrorJoint(
            name, names[-1 - i], *_estimates(test.difference[i], half[:, i]), float(joint_p[i])
        )
        for i, name in enumerate(names)
    )


def _estimates(value: complex, half: FloatArray) -> tuple[Estimate, Estimate]:
    """Return log gain and lag, positive when late, with their half widths."""
    gain, lag = float(value.real), -float(value.imag)
    return (
        Estimate(gain, around(gain, float(half[0]))),
        Estimate(lag, around(lag, float(half[1]))),
    )
