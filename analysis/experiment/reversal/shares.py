"""How much of the spread over the joints is the boundary's, and how much the modules' own.

With y_i(+) = b_i + delta_i and y_i(-) = b_{m+1-i} + delta_i, where b is what identical modules do
and delta_i is module i's own (independent of its mirror joint's, with variance V_module), the
mirrored difference is d_i = delta_i - delta_{m+1-i}, so::

    V_module   = 2 max(0, mean |d / 2|^2 - noise)
    V_boundary = V_total - V_module - noise

|.|^2 adds log gain and lag [rad], which weigh alike in the complex response. The middle joint of
an odd number is its own mirror joint and left out of V_module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from ...estimators.intervals import CONFIDENCE
from ...results.estimate import Estimate, Interval

RESAMPLES = 2_000


@dataclass(frozen=True)
class Shares:
    """Where the spread of the response over the joints comes from.

    Attributes:
        module_variance: V_module, of log gain plus lag [1 = rad^2], with interval.
        boundary_variance: V_boundary, never below zero, with interval.
        noise_variance: What noise adds to V_total.
        module_share: V_module / (V_module + V_boundary) with interval; empty where noise explains
            all of the spread.
    """

    module_variance: Estimate
    boundary_variance: Estimate
    noise_variance: float
    module_share: Estimate

    @property
    def boundary_share(self) -> Estimate:
        """The rest, with interval."""
        value, ci95 = self.module_share.value, self.module_share.ci95
        if value is None or ci95 is None:
            return Estimate()
        return Estimate(1 - value, (1 - ci95[1], 1 - ci95[0]))


def variance_shares(forward: ComplexArray, reverse: ComplexArray, seed: int = 1) -> Shares:
    """Split the spread over the joints.

    Args:
        forward: y of the runs one way, shape (r1, m), m >= 2, r1 >= 2.
        reverse: y of the runs the other way, shape (r2, m), r2 >= 2.
        seed: Of the bootstrap.

    Returns:
        The shares. Intervals by bootstrap over runs, each way resampled for itself. A resample
        of r runs scatters by (r - 1)/r too little, which is made good, and adds the noise once
        more, which is subtracted once more.
    """
    mirrored = reverse[:, ::-1]
    random = np.random.default_rng(seed)
    noise = np.stack([_noise(forward), _noise(mirrored)])
    means = np.stack([forward.mean(axis=0), mirrored.mean(axis=0)])
    module, boundary = _variances(means, noise)
    drawn = np.stack([_resampled(one, random) for one in (forward, mirrored)])
    modules, boundaries = _variances(drawn, 2 * noise)
    whole, wholes = module + boundary, modules + boundaries
    share = Estimate()
    if whole > 0:
        some = wholes > 0
        parts = np.divide(modules, wholes, out=np.zeros_like(modules), where=some)[some]
        share = Estimate(float(module / whole), _percentiles(parts))
    return Shares(
        module_variance=Estimate(float(module), _percentiles(modules)),
        boundary_variance=Estimate(float(boundary), _percentiles(boundaries)),
        noise_variance=float(noise.mean()),
        module_share=share,
    )


def _variances(means: ComplexArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """V_module and V_boundary of both ways' profiles, the reverse mirrored, shape (2, ..., m)."""
    joint: IntArray = np.arange(means.shape[-1], dtype=np.int64)
    paired: BoolArray = joint != joint[::-1]
    half: FloatArray = np.abs((means[0] - means[1]) / 2)[..., paired] ** 2
    excess = half.mean(axis=-1) - noise.sum(axis=0)[paired].mean() / 4
    module: FloatArray = 2 * np.maximum(0.0, excess)
    total: FloatArray = np.var(means, axis=-1, ddof=1).mean(axis=0)
    return module, np.maximum(0.0, total - module - noise.mean())


def _noise(runs: ComplexArray) -> FloatArray:
    """Variance of the mean of r runs, gain and lag together, shape (m,)."""
    return np.var(runs, axis=0, ddof=1) / len(runs)


def _resampled(runs: ComplexArray, random: np.random.Generator) -> ComplexArray:
    """Means of resampled runs, shape (RESAMPLES, m)."""
    r = len(runs)
    weights = random.multinomial(r, np.full(r, 1 / r), size=RESAMPLES) / r
    mean = runs.mean(axis=0)
    return mean + (r / (r - 1)) ** 0.5 * (weights @ (runs - mean))


def _percentiles(values: FloatArray) -> Interval | None:
    if not values.size:
        return None
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)
