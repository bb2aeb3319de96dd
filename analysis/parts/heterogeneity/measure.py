"""How unlike the joints of one plane are, each index with its interval.

The indices describe these joints, not a population they might be drawn from: joints are fixed,
only the measurement is uncertain. So a sum of squared deviations D of m estimates is a noncentral
chi-square whose noncentrality is the true spread; with variances that are estimated and unequal,
F = D / E0[D] with Box's degrees of freedom (Ann. Math. Stat. 25, 1954). What noise alone would
spread is subtracted, so that identical joints give about zero. Intervals of a spread invert the
noncentral chi-square (as for effect sizes: Steiger, Psychological Methods 9, 2004).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, chndtrinc, fdtrc, ndtri, stdtr

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.robot.model import Robot

from ...common.estimate import Interval
from ...common.remarks import Note
from ...estimators.intervals import (
    CONFIDENCE,
    EQUIVALENT_GAIN,
    EQUIVALENT_LAG_RAD,
    around,
    equivalence_p,
    t_factor,
)
from ...response.fitting import GaitFit
from ...response.response import Response
from ...signals.columns import by_plane
from ..energy.measure import Energies
from ..joints.result import JointResult
from .result import Index

ENDS = 2
MIDDLE = 5

KINDS: dict[str, tuple[str, str]] = {
    "gain_cv": ("1", "coefficient of variation of gain"),
    "lag_sd": ("rad", "circular standard deviation of lag"),
    "boundary_contrast_gain": ("1", "gain, two end joints minus middle five"),
    "boundary_contrast_lag": ("rad", "lag, two end joints minus middle five"),
    "common_response": ("1", "F of H0: all joints have the same gain and delay"),
    "equivalence_gain": ("1", "largest deviation from the mean; H1: all within 2 %"),
    "equivalence_lag": ("rad", "largest deviation from the mean; H1: all within 1 degree"),
    "energy_cv": ("1", "coefficient of variation of E_abs"),
    "energy_gini": ("1", "Gini coefficient of E_abs"),
    "module_share": ("1", "share of the spread that is due to the modules themselves"),
}
"""Every index: its unit and what it measures."""

_ASYMPTOTIC = 1e4
"""D over noise beyond which the noncentral distribution is replaced by its normal limit."""


@dataclass(frozen=True)
class Spread:
    """Sum of squared deviations and what noise alone would make of it.

    Attributes:
        squares: D, sum of squared deviations from the mean.
        expected: E0[D] without any true spread.
        dof: Box's degrees of freedom of D.
        noise_dof: Degrees of freedom of the noise estimate.
        count: Joints m.
    """

    squares: float
    expected: float
    dof: float
    noise_dof: float
    count: int

    @property
    def ratio(self) -> float:
        """F = D / E0[D]."""
        return self.squares / self.expected if self.expected > 0 else float("inf")

    @property
    def p(self) -> float:
        """p-value of no true spread."""
        return float(fdtrc(self.dof, self.noise_dof, self.ratio))

    @property
    def deviation(self) -> float:
        """True standard deviation over the m joints, noise subtracted, never below zero."""
        return max(0.0, (self.squares - self.expected) / self.count) ** 0.5

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the true standard deviation."""
        if self.expected == 0:
            return self.deviation, self.deviation
        # Noise that is itself estimated: wider by what Student's factor is over the normal one.
        widened = t_factor(self.noise_dof) / t_factor(np.inf)
        noise = widened**2 * self.expected / self.dof
        tail = (1 - CONFIDENCE) / 2
        roots = [_noncentral_root(self.squares / noise, self.dof, q) for q in (1 - tail, tail)]
        low, high = (root * (noise / self.count) ** 0.5 for root in roots)
        return low, high


def index(
    name: str, value: float | None = None, ci95: Interval | None = None, p: float | None = None
) -> Index:
    """Return an index of one of ``KINDS`` with its unit and label."""
    return Index(value, ci95, p, *KINDS[name])


def response_indices(response: Response) -> dict[str, Index]:
    """Return the indices of gain and lag of one plane's driven joints, head to tail.

    Args:
        response: Of k joints in chain order.

    Returns:
        ``gain_cv``, ``lag_sd``, ``boundary_contrast_gain``, ``boundary_contrast_lag``,
        ``common_response``, ``equivalence_gain``, ``equivalence_lag``. None of them for fewer
        than two joints, no contrasts for fewer than seven.
    """
    count = response.ratio.size
    if count < 2:
        return {}
    dof = response.dof
    gain, lag = response.gain, response.lag_near_mean_rad
    relative = gain / gain.mean()
    gain_variance, lag_variance = response.log_gain_variance * relative**2, response.lag_variance
    variances = np.concatenate([response.log_gain_variance, lag_variance])
    both = spread(np.concatenate([np.log(gain), lag]), variances, dof, blocks=2)
    gains = spread(relative, gain_variance, dof)
    lags = _circular(lag, spread(lag, lag_variance, dof))
    entries: dict[str, tuple[float, Interval | None, float]] = {
        "gain_cv": (gains.deviation, gains.interval, gains.p),
        "lag_sd": (lags.deviation, lags.interval, lags.p),
        "common_response": (both.ratio, None, both.p),
        "equivalence_gain": _equivalence(relative - 1, gain_variance, dof, EQUIVALENT_GAIN),
        "equivalence_lag": _equivalence(lag - lag.mean(), lag_variance, dof, EQUIVALENT_LAG_RAD),
    }
    if count >= MIDDLE + ENDS:
        entries["boundary_contrast_gain"] = _contrast(
            gain, response.log_gain_variance * gain**2, dof
        )
        entries["boundary_contrast_lag"] = _contrast(lag, lag_variance, dof)
    return {name: index(name, *numbers) for name, numbers in entries.items()}


def energy_indices(per_cycle_j: FloatArray) -> dict[str, Index]:
    """Spread of E_abs over the joints of one plane.

    Args:
        per_cycle_j: E_abs of k joints in each of c whole cycles [J], shape (k, c).

    Returns:
        ``energy_cv`` and ``energy_gini`` with jackknife intervals over cycles (None for fewer than
        three); empty for fewer than two joints or no energy.
    """
    if per_cycle_j.shape[0] < 2 or not np.any(per_cycle_j):
        return {}
    return {
        "energy_cv": index(
            "energy_cv",
            *_jackknifed(per_cycle_j, lambda energy: float(energy.std() / energy.mean())),
        ),
        "energy_gini": index("energy_gini", *_jackknifed(per_cycle_j, gini)),
    }


def gini(values: FloatArray) -> float:
    """Gini coefficient: half the mean absolute difference of two joints over the mean.

    Args:
        values: Not negative, shape (k,).

    Returns:
        0 where all are alike, (k - 1)/k where one has it all.
    """
    ordered = np.sort(values)
    k = ordered.size
    return float((2 * np.arange(1, k + 1) - k - 1) @ ordered / (k * ordered.sum()))


def spread(values: FloatArray, variance: FloatArray, dof: FloatArray, blocks: int = 1) -> Spread:
    """Sum of squares about the mean, and Box's approximation of its distribution under noise.

    Args:
        values: Independent estimates, shape (blocks * m,).
        variance: Their variances, same shape.
        dof: Degrees of freedom of the variances of each joint, shape (m,).
        blocks: Number of blocks with a mean of their own.
    """
    rows, noise = values.reshape(blocks, -1), variance.reshape(blocks, -1)
    m = rows.shape[1]
    squares = float(np.sum((rows - rows.mean(axis=1, keepdims=True)) ** 2))
    expected = float(np.sum(noise)) * (1 - 1 / m)
    # Trace of (C V)^2 with C the centring matrix and V the diagonal of the variances; the square
    # of a variance that was estimated is too large by 1 + 2/dof.
    squared = noise**2 * dof / (dof + 2)
    second = (1 - 2 / m) * np.sum(squared) + np.sum(noise.sum(axis=1) ** 2) / m**2
    if expected == 0:
        return Spread(squares, 0.0, float(blocks * (m - 1)), float(dof.sum()), m)
    # The blocks of one joint share its noise estimate.
    joint = noise.sum(axis=0)
    noise_dof = float(joint.sum() ** 2 / np.sum(joint**2 / (dof + 2)))
    box = min(expected**2 / float(second), blocks * (m - 1.0))
    return Spread(squares, expected, box, noise_dof, m)


def _circular(lag: FloatArray, linear: Spread) -> Spread:
    """Return the spread with the circular variance -2 ln R (Mardia & Jupp 2000) for its squares."""
    length = float(np.abs(np.mean(np.exp(1j * lag))))
    if length < 1e-12:
        return linear
    squares = -2 * np.log(length) * linear.count
    return Spread(squares, linear.expected, linear.dof, linear.noise_dof, linear.count)


def _noncentral_root(value: float, dof: float, quantile: float) -> float:
    """Root of the noncentrality whose chi-square has the value at this quantile; 0 if none has."""
    if value > _ASYMPTOTIC:
        return float(value**0.5 - ndtri(quantile))
    return 0.0 if chdtr(dof, value) <= quantile else float(chndtrinc(value, dof, quantile)) ** 0.5


def _contrast(
    values: FloatArray, variance: FloatArray, dof: FloatArray
) -> tuple[float, Interval, float]:
    """Return the mean of the first and last joint minus mean of the middle five; interval and p."""
    count = values.size
    weight = np.zeros(count)
    weight[[0, -1]] = 1 / ENDS
    first = (count - MIDDLE) // 2
    weight[first : first + MIDDLE] -= 1 / MIDDLE
    parts = weight**2 * variance
    value, error = float(weight @ values), float(parts.sum()) ** 0.5
    freedom = float(parts.sum() ** 2 / np.sum(parts**2 / dof)) if error > 0 else float(dof.min())
    return value, around(value, t_factor(freedom) * error), _t_p(value, error, freedom)


def _t_p(value: float, error: float, dof: float) -> float:
    return float(2 * stdtr(dof, -abs(value) / error)) if error > 0 else float(value == 0)


def _equivalence(
    deviation: FloatArray, variance: FloatArray, dof: FloatArray, margin: float
) -> tuple[float, None, float]:
    """Largest deviation from the mean, and the equivalence test that all are within a margin."""
    m = deviation.size
    error = np.sqrt(variance * (1 - 2 / m) + variance.sum() / m**2)
    return float(np.max(np.abs(deviation))), None, equivalence_p(deviation, error, dof, margin)


def _jackknifed(
    per_cycle: FloatArray, statistic: Callable[[FloatArray], float]
) -> tuple[float, Interval | None]:
    """Return the statistic of the joints' totals, leaving out one cycle at a time (Tukey 1958)."""
    cycles = per_cycle.shape[1]
    total = per_cycle.sum(axis=1)
    value = statistic(total)
    if cycles < 3:
        return value, None
    rest = total[:, None] - per_cycle  # (k, c)
    if not rest.any(axis=0).all():  # all of the energy is in one cycle
        return value, None
    partial = np.array([statistic(total) for total in rest.T])
    error = ((cycles - 1) / cycles * np.sum((partial - partial.mean()) ** 2)) ** 0.5
    half = t_factor(cycles - 1) * float(error)
    return value, (max(0.0, value - half), value + half)


def heterogeneity_indices(
    robot: Robot | None,
    gait: GaitFit | None,
    joints: tuple[JointResult, ...],
    energies: Mapping[str, Energies],
    warn: Warn,
) -> dict[str, Index]:
    """Indices of each driven plane, and in it of each group of joints that share a rhythm.

    Args:
        robot: The robot, or None; then all joints are one chain.
        gait: The fitted gait, or None.
        warn: Told why an index is None.

    Returns:
        Every index of :data:`.KINDS`, None where it can't be computed. Where
        both planes are driven each has its own, named e.g. ``gain_cv_horizontal``; where joints of
        one plane have several frequencies each group has its own, e.g. ``gain_cv_vertical_group1``.
    """
    unknown = {name: index(name) for name in KINDS}
    if gait is None or all(group.response is None for group in gait.groups):
        warn(Note("no joint's gain and lag are known: the heterogeneity indices are null"))
        return unknown
    lagged = {joint.name for joint in joints if joint.lag_rad.value is not None}
    old = {joint.name for joint in joints if joint.name in lagged and "stale" in joint.flags}
    if old != lagged:  # where all samples are late by a hold, that makes no difference
        lagged -= old
    groups = [by_plane(robot, group.driven) for group in gait.groups]
    planes = list(dict.fromkeys(plane for group in groups for plane in group))
    result: dict[str, Index] = {}
    parts = [(plane, k) for plane in planes for k, group in enumerate(groups) if plane in group]
    for plane, k in parts:
        names = groups[k][plane]
        sound = [name for name in names if name in lagged]
        several = sum(plane in group for group in groups) > 1
        label = f"{plane} {gait.groups[k].fit.frequency_hz:.4g} Hz" if several else plane
        indices = unknown | _of_plane(label, names, sound, gait.groups[k], warn)
        powers = [energies[name].mechanical for name in sound]
        per_cycle = [power.abs_j for power in powers if power is not None]
        if per_cycle and len(per_cycle) == len(sound):
            indices |= energy_indices(np.stack(per_cycle))
        suffix = f"_{plane}" if len(planes) > 1 else ""
        suffix += f"_group{k}" if several else ""
        result |= {f"{name}{suffix}": value for name, value in indices.items()}
    text = "boundary or module: not separable from a wave in one direction (module_share is null)"
    warn(Note(f"{text}; record the reverse"))
    return result


def _of_plane(
    plane: str, names: list[str], sound: list[str], gait: GaitFit, warn: Warn
) -> dict[str, Index]:
    """Return the indices of gain and lag of one plane; its contrasts need every joint of it."""
    if gait.response is None or len(sound) < 2:
        few = f"fewer than two {plane} joints have a response"
        warn(Note(f"{few}: its heterogeneity indices are null"))
        return {}
    indices = response_indices(gait.response.select([gait.answered.index(name) for name in sound]))
    if len(names) < MIDDLE + ENDS:
        few = f"{len(names)} driven {plane} joints are too few for a contrast of the ends"
        warn(Note(f"{few} with the middle {MIDDLE}: the boundary contrasts are null"))
    elif len(sound) < len(names):
        warn(
            f"the {plane} indices leave out joints without gain and lag; the boundary contrasts, "
            "which need them all, are null"
        )
        indices = {
            k: value for k, value in indices.items() if not k.startswith("boundary_contrast")
        }
    return indices
