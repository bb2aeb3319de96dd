"""Estimates of two sides and their differences, those of motions without commands among them.

Two single sessions differ by B minus A, each with the standard error of its own noise; groups of
runs by the difference of their means, after Welch (Biometrika 34, 1947), or, run by run, by the
mean of the paired differences. All quantities of a comparison are one family: decisions are
Holm's (Scand. J. Stat. 6, 1979), and the intervals hold together at 95 % after Bonferroni, so an
interval may contain 0 where Holm's sharper procedure decides.

Lags and waves are those along the joints that move in every session, so that a joint at rest in one
of them changes no other joint's lag.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import stdtr, stdtrit

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.robot.model import Robot

from ..estimators.intervals import CONFIDENCE, welch_satterthwaite
from ..parts.body.oscillation import (
    MotionFit,
    Oscillation,
    amplitude,
    phase_lag,
    phase_line,
    travelling_index,
)
from ..results.comparison import BODY
from ..signals.columns import by_plane

Key = tuple[str, str]
"""Quantity and where it is: a joint's name or ``body``."""

Known = tuple[float, float, float]
"""Value, variance, degrees of freedom."""

MIN_RUNS = 2
"""Runs a side below which nothing is known of their scatter."""

_ROUNDING = 1e-9
"""Scatter of runs that agree, relative to their values: simulated runs may differ by rounding."""


@dataclass(frozen=True)
class Quantities:
    """Estimates of k quantities from one side.

    Attributes:
        value: Shape (k,).
        variance: Of the estimates, shape (k,).
        dof: Degrees of freedom of the variances, shape (k,).
    """

    value: FloatArray
    variance: FloatArray
    dof: FloatArray


@dataclass(frozen=True)
class Differences:
    """B minus A.

    Attributes:
        value: Shape (k,).
        error: Standard errors, shape (k,).
        dof: Their degrees of freedom, shape (k,).
    """

    value: FloatArray
    error: FloatArray
    dof: FloatArray

    @property
    def p(self) -> FloatArray:
        """Two-sided p-value of each by itself, shape (k,); 1 for 0 without any error."""
        size = np.abs(self.value)
        certain = np.where(size > 0, np.inf, 0.0)
        score = np.divide(size, self.error, out=certain, where=self.error > 0)
        return np.asarray(2 * stdtr(self.dof, -score), dtype=np.float64)

    @property
    def half(self) -> FloatArray:
        """Half widths of intervals that hold together at 95 %, shape (k,)."""
        level = (1 - CONFIDENCE) / max(self.value.size, 1)
        return np.asarray(stdtrit(self.dof, 1 - level / 2) * self.error, dtype=np.float64)


def from_runs(runs: FloatArray) -> Quantities:
    """Return a side's means over its runs.

    Args:
        runs: Shape (r, k), r at least 2.

    Returns:
        Means, their variances from the scatter of the runs, r - 1 degrees of freedom.

    Raises:
        UsageError: If there are fewer than 2 runs.
    """
    if len(runs) < MIN_RUNS:
        raise UsageError(
            f"{len(runs)} run on one side: groups need {MIN_RUNS} runs a side at least; two single "
            "sessions are compared without --a and --b"
        )
    mean: FloatArray = runs.mean(axis=0)
    rounding = _ROUNDING * np.abs(runs).max(axis=0)
    return Quantities(
        value=mean,
        variance=np.maximum(runs.var(axis=0, ddof=1), rounding**2) / len(runs),
        dof=np.full_like(mean, len(runs) - 1.0),
    )


def independent(a: Quantities, b: Quantities) -> Differences:
    """Return B minus A of independent sides (Welch).

    Args:
        a: One side, k quantities.
    """
    variances = np.stack([a.variance, b.variance])
    return Differences(
        value=b.value - a.value,
        error=np.sqrt(variances.sum(axis=0)),
        dof=welch_satterthwaite(variances, np.stack([a.dof, b.dof])),
    )


def paired(a: FloatArray, b: FloatArray) -> Differences:
    """Return the mean of B minus A, run by run.

    Args:
        a: Shape (r, k).
        b: Shape (r, k); run i belongs to run i of ``a``.

    Raises:
        UsageError: If there are fewer than 2 pairs, or the runs don't pair up.
    """
    if len(a) != len(b):
        raise UsageError(f"{len(a)} and {len(b)} runs don't make pairs; leave out --paired")
    means = from_runs(b - a)
    # Rounding is that of the values, not of their small difference.
    rounding = _ROUNDING * np.abs([a, b]).max(axis=(0, 1))
    variance = np.maximum(means.variance, rounding**2 / len(a))
    return Differences(means.value, np.sqrt(variance), means.dof)


@dataclass(frozen=True)
class PeriodicMotion:
    """The periodic motion of one session.

    Attributes:
        label: The file's name, for messages.
        robot: Its robot, or None.
        names: Joints that are not constant, in chain order.
        oscillation: Their fundamentals.
        chain: These joints and those that are constant, in chain order.
        log_frequency: ln of the frequency [Hz], its variance and degrees of freedom.
    """

    label: str
    robot: Robot | None
    names: tuple[str, ...]
    oscillation: Oscillation
    chain: tuple[str, ...]
    log_frequency: Known

    @property
    def phased(self) -> frozenset[str]:
        """Names of the joints with a phase."""
        has_phase = self.oscillation.known_phases()
        return frozenset(name for name, phased in zip(self.names, has_phase, strict=True) if phased)

    def phase_rad(self, joint: str) -> float:
        """Return the phase of a joint's fundamental at t = 0."""
        return float(np.angle(self.oscillation.amplitudes[self.names.index(joint)]))


def motion_of(label: str, robot: Robot | None, fitted: MotionFit) -> PeriodicMotion:
    """Return what is compared of a fitted motion.

    Args:
        label: The file's name.
    """
    relative = fitted.oscillation.omega_variance / fitted.fit.omega**2
    log_frequency = float(np.log(fitted.fit.frequency_hz)), relative, fitted.omega_dof
    return PeriodicMotion(
        label, robot, fitted.names, fitted.oscillation, fitted.chain, log_frequency
    )


@dataclass(frozen=True)
class CommonMotion:
    """Joints of several motions that can be compared.

    Attributes:
        names: Joints with a phase in every session, in chain order.
        near_rest: Joints with a phase in some sessions only, recorded in all.
        left_out: Joints without a phase or a record in some session, and why.
        planes: Of ``names``, each with the numbers of its joints in the plane.
        phases_rad: Unwrapped phases of each plane's joints in the first session.
        before: The joint before each in its plane.
    """

    names: tuple[str, ...]
    near_rest: tuple[str, ...]
    left_out: Mapping[str, str]
    planes: Mapping[str, tuple[tuple[str, ...], FloatArray]]
    phases_rad: Mapping[str, FloatArray]
    before: Mapping[str, str]


def common_motion(motions: Sequence[PeriodicMotion]) -> CommonMotion:
    """Find the joints that can be compared.

    Args:
        motions: Of the sessions of both sides.

    Raises:
        DataError: If no joint moves in all of them.
    """
    # Joints of the first session, then others, which no other session can shift.
    recorded = [frozenset(motion.chain) for motion in motions]
    phased = [motion.phased for motion in motions]
    joints = list(dict.fromkeys(name for motion in motions for name in motion.chain))
    names = tuple(name for name in joints if all(name in moving for moving in phased))
    if not names:
        raise DataError(
            "no joint moves at the common frequency in all sessions, so nothing can be compared: "
            + "; ".join(f"in {motion.label} {_some(motion)}" for motion in motions)
        )
    left_out: dict[str, str] = {}
    for name in joints:
        unknown = [
            motion.label
            for motion, chain in zip(motions, recorded, strict=True)
            if name not in chain
        ]
        at_rest = [
            motion.label
            for motion, chain, moves in zip(motions, recorded, phased, strict=True)
            if name in chain and name not in moves
        ]
        if len(at_rest) == len(motions):
            continue  # at rest on both sides
        parts = [f"not recorded in {', '.join(unknown)}"] if unknown else []
        parts += [f"no phase in {', '.join(at_rest)}"] if at_rest else []
        if parts:
            left_out[name] = ", ".join(parts)
    robot = next((motion.robot for motion in motions if motion.robot is not None), None)
    planes: dict[str, tuple[tuple[str, ...], FloatArray]] = {}
    phases: dict[str, FloatArray] = {}
    before: dict[str, str] = {}
    for plane, members in by_plane(robot, joints).items():
        chain = tuple(name for name in members if name in names)
        before |= {joint: last for last, joint in pairwise(chain)}
        if len(chain) > 1:
            index = np.array([members.index(name) for name in chain], dtype=np.float64)
            planes[plane] = chain, index
            phases[plane] = phase_line(_select(motions[0], chain), index, index).phases_rad
    return CommonMotion(
        names=names,
        near_rest=tuple(n for n in left_out if all(n in chain for chain in recorded)),
        left_out=left_out,
        planes=planes,
        phases_rad=phases,
        before=before,
    )


def motion_estimates(motion: PeriodicMotion, common: CommonMotion) -> dict[Key, Known]:
    """Return the quantities of a motion that are compared.

    Returns:
        ln amplitude [1] and phase lag [rad] of the joints, amplitude of joints near rest [rad];
        ln frequency [Hz], wave number [rad/joint] and travelling index of the body.
    """
    estimates: dict[Key, Known] = {}
    oscillation, dof = motion.oscillation, motion.oscillation.dof
    row = {name: k for k, name in enumerate(motion.names)}
    for name in common.names:
        size, error = amplitude(oscillation, row[name])
        estimates["amplitude", name] = float(np.log(size)), (error / size) ** 2, dof
    for name in common.near_rest:
        size, error = amplitude(oscillation, row[name]) if name in row else (0.0, 0.0)
        estimates["rest_amplitude", name] = size, error**2, dof
    for name, last in common.before.items():
        lag, error = phase_lag(oscillation, row[name], row[last])
        if lag.value is not None:
            estimates["phase_lag", name] = lag.value, error**2, dof
    estimates["frequency", BODY] = motion.log_frequency
    for plane, (chain, index) in common.planes.items():
        place = BODY if len(common.planes) == 1 else f"{BODY}, {plane}"
        chosen = _select(motion, chain)
        line = phase_line(chosen, index, index, common.phases_rad[plane])
        if line.slope.value is not None:
            estimates["wave_number", place] = line.slope.value, line.error**2, dof
        travelling, error = travelling_index(chosen)
        if travelling.value is not None:
            estimates["travelling_index", place] = travelling.value, error**2, dof
    return estimates


def _select(motion: PeriodicMotion, names: Sequence[str]) -> Oscillation:
    index = np.array([motion.names.index(name) for name in names], dtype=np.int64)
    return motion.oscillation.select(index)


def _some(motion: PeriodicMotion) -> str:
    moving = [name for name in motion.names if name in motion.phased]
    return (
        f"{', '.join(moving[:4])}{', ...' if len(moving) > 4 else ''} do" if moving else "none do"
    )
