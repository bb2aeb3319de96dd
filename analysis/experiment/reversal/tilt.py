"""Could a tilted floor make what looks like a module? Three checks that need no model.

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
docs/heterogeneity.md. Runs with the robot turned by half a turn (:mod:`.reversal.mirror`)
need none of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

from ...estimators.intervals import CONFIDENCE, around, t_factor
from ...results.estimate import Estimate, Interval
from .mirror import MirrorTest

MODULE_RATIO = 1.0
"""Common over contrast below which the pattern is a module's rather than a tilt's."""

LEVEL_RAD = math.radians(0.1)
"""Lean of recorded gravity that the motion itself may make."""

LEAST_LEANS = 3
"""Runs with recorded gravity below which its scatter is unknown."""

RESAMPLES = 2_000


@dataclass(frozen=True)
class TiltCheck:
    """What speaks for and against a tilted floor in runs that do not cancel it.

    Attributes:
        ratio: Root mean square of the common part over that of the contrast, over the body, with
            interval; empty where noise explains all of the contrast.
        middle: Largest size that the middle joint's d_i can have (95 %) over the smallest that the
            largest contrast can have; None for an even number of joints.
        excluded: Whether both exclude a tilt as the cause.
    """

    ratio: Estimate
    middle: float | None
    excluded: bool


def tilt_check(
    forward: ComplexArray,
    reverse: ComplexArray,
    test: MirrorTest,
    gravity_rad: Estimate | None = None,
    *,
    seed: int = 1,
) -> TiltCheck:
    """Check whether the differences of a reversal exclude a tilted floor as their cause.

    Args:
        forward: y of the runs one way, shape (r1, m).
        reverse: y of the runs the other way, shape (r2, m), joints from head to tail too.
        test: Their reversal test.
        gravity_rad: Lean of recorded gravity along the body with its interval, None or empty where
            none is recorded.
        seed: Of the bootstrap.

    Returns:
        The check.
    """
    ratio = common_ratio(forward, reverse, seed)
    excluded = ratio.ci95 is not None and ratio.ci95[1] < MODULE_RATIO
    middle = None
    m = len(test.difference)
    if m % 2:
        middle = _middle_share(test)
        excluded &= middle < 1.0
    lean = None if gravity_rad is None else gravity_rad.ci95
    excluded &= lean is None or (lean[0] < LEVEL_RAD and lean[1] > -LEVEL_RAD)
    return TiltCheck(ratio, middle, excluded)


def floor_lean(lean_rad: FloatArray, heading_rad: FloatArray) -> Estimate:
    """Fall of the floor along the body by recorded gravity.

    Args:
        lean_rad: Of each run [rad], NaN where none is recorded, shape (r,).
        heading_rad: Of the robot in each run [rad], NaN where it is unknown, shape (r,).

    Returns:
        The fall along the first run's heading with its interval over the runs; where the headings
        differ by half a turn the sensor's own offset is taken out. Empty with fewer than three
        runs.
    """
    known = np.isfinite(lean_rad)
    lean, heading = lean_rad[known], heading_rad[known]
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


def common_ratio(forward: ComplexArray, reverse: ComplexArray, seed: int = 1) -> Estimate:
    """Root mean square of the common part of d over that of the contrast, noise subtracted.

    Args:
        forward: y of the runs one way, shape (r1, m).
        reverse: y of the runs the other way, shape (r2, m).
        seed: Of the bootstrap over runs, each way resampled for itself.

    Returns:
        The ratio with its percentile interval; empty where the contrast is no more than noise.
    """
    random = np.random.default_rng(seed)
    mirrored = reverse[:, ::-1]
    noise = np.zeros((2,))
    means: list[ComplexArray] = []
    drawn: list[ComplexArray] = []
    for runs in (forward, mirrored):
        r = len(runs)
        parity = np.stack([runs + runs[:, ::-1], runs - runs[:, ::-1]]) / 2
        noise += parity.var(axis=1, ddof=1).sum(axis=-1) / r
        means.append(parity.mean(axis=1))
        weights = random.multinomial(r, np.full(r, 1 / r), size=RESAMPLES) / r
        # A resample of r runs scatters by (r - 1)/r too little.
        wider = (r / (r - 1)) ** 0.5
        centred = parity - parity.mean(axis=1, keepdims=True)
        drawn.append(parity.mean(axis=1)[:, None] + wider * (weights @ centred))
    power = np.sum(np.abs(means[0] - means[1]) ** 2, axis=-1) - noise
    if power[1] <= 0:
        return Estimate()
    # The bootstrap adds the noise once more, which is subtracted once more.
    powers = np.sum(np.abs(drawn[0] - drawn[1]) ** 2, axis=-1) - 2 * noise[:, None]
    ratios = np.sqrt(np.maximum(powers[0], 0.0) / np.maximum(powers[1], np.finfo(np.float64).tiny))
    value = float(np.sqrt(max(power[0], 0.0) / power[1]))
    return Estimate(value, _percentiles(ratios))


def heading_strata(
    forward: FloatArray, reverse: FloatArray, tolerance_rad: float
) -> tuple[IntArray, IntArray] | None:
    """Strata of runs that are mirror images of each other, from the robot's headings.

    Args:
        forward: Heading of each run one way [rad], NaN where it is unknown, shape (r1,).
        reverse: The same the other way, shape (r2,).
        tolerance_rad: Headings that differ by no more are the same [rad].

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
        near = [
            s for s, leader in enumerate(leaders) if abs(_turned(key - leader)) <= tolerance_rad
        ]
        if near:
            index[k] = near[0]
        else:
            index[k] = len(leaders)
            leaders.append(key)
    plus = np.bincount(index[: len(forward)], minlength=len(leaders))
    minus = np.bincount(index[len(forward) :], minlength=len(leaders))
    if min(plus.min(), minus.min()) < 2:
        return None
    return index[: len(forward)], index[len(forward) :]


def _middle_share(test: MirrorTest) -> float:
    """Upper bound of the middle joint's size over the lower bound of the largest contrast's."""
    k = len(test.difference) // 2
    contrast = np.abs(np.stack([test.contrast.real, test.contrast.imag]))
    least = float((contrast - test.critical * test.contrast_error).max())
    middle = np.abs([test.difference[k].real, test.difference[k].imag])
    most = float((middle + test.critical * test.error[:, k]).max())
    return most / least if least > 0 else float("inf")


def _turned(angle: float) -> float:
    """An angle in (-pi, pi]."""
    return float(np.angle(np.exp(1j * angle)))


def _percentiles(values: FloatArray) -> Interval:
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)
