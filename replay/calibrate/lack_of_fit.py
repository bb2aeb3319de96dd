"""Does the twin fit at all? An interval holds for noise, and a wrong law leaves what is no noise.

Checks of the residual r = measured - twin at the fit:

* **In time with the gait** (a portmanteau test per joint). Noise, white or with a memory, has a
  smooth spectrum; what a law lacks comes back every cycle. The power of r at each of the gait's
  harmonics, the first ``HARMONICS`` of them, is held against that at the frequencies between them:
  F with 2 and 2 L degrees of freedom, the p-values of the harmonics put together by Fisher's method
  (Statistical Methods for Research Workers, 1932, 21.1). The fit has taken what it could from these
  lines, so under noise the test is conservative.
* Without a steady gait, **whether r is noise of one memory**: the test of Ljung and Box (Biometrika
  65, 1978) of what a first-order recursion leaves.
* **Data not fitted**. Each half of the session is fitted by itself (to first order, around the fit
  of all), and predicts the other: x_1 - x_2 against its covariance, chi^2 with K degrees of
  freedom, and the error on the half that was not used.
* **Other laws** (:mod:`.identifiability`), each in its own direction.

Joints may share noise, so their p-values are multiplied by their number (Bonferroni).

How far the twin is from the robot, joint by joint: RMS, gain and time.

Without a gait to assume: the measured angle is regressed on the twin's angle q and its rate::

    measured = (1 + g) (q - d q')

to first order in d; g is what the robot's amplitude is larger by, d how much later it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.special import chdtrc, fdtrc

from undulog.capture.common.arrays import FloatArray

from .identifiability import Alternative
from .least_squares import LeastSquares, larger
from .recorded import MeasuredAngles

_STILL = 1e-3  # a joint that moves less has no gain [rad, RMS]

HARMONICS = 5
"""Of the gait that are looked at."""

BETWEEN = 3
"""Frequencies to each side of a harmonic, one resolution 1/T apart, that give the noise level."""

FEWEST_CYCLES = 3.0
"""Least number of cycles that separates the lines from the noise between them."""

LAGS = 20
"""Of the test of Ljung and Box."""

LEVEL = 0.05
"""Family-wise p below which the twin counts as not fitting."""


_Slices: TypeAlias = Sequence[slice]


@dataclass(frozen=True)
class JointMisfit:
    """One joint.

    Attributes:
        rms: Of measured minus twin [rad].
        gain: g, positive where the robot moves more than the twin; None of a joint that is still.
        late_s: d [s], positive where the robot is later; likewise.
    """

    rms: float
    gain: float | None = None
    late_s: float | None = None


def misfit(times_s: FloatArray, measured: FloatArray, twin: FloatArray) -> JointMisfit:
    """Hold one joint against the twin's.

    Args:
        times_s: Sampling times [s], shape (n,).
        measured: Less the mean [rad], shape (n,).
    """
    rms = float(np.sqrt(np.mean((measured - twin) ** 2)))
    if np.sqrt(np.mean(twin**2)) < _STILL or np.unique(times_s).size < times_s.size:
        return JointMisfit(rms)
    rate = np.gradient(twin, times_s)
    along, late = np.linalg.lstsq(np.stack([twin, rate - rate.mean()], axis=1), measured)[0]
    return JointMisfit(rms, float(along - 1.0), float(-late / along))


@dataclass(frozen=True)
class JointFit:
    """What is left at one joint.

    Attributes:
        periodic_rad: RMS of what comes back every cycle, noise taken off [rad]; None without gait.
    """

    p: float
    periodic_rad: float | None


@dataclass(frozen=True)
class Unfitted:
    """Halves of what was recorded, or sessions, that predict each other.

    Attributes:
        p: Of 'both halves ask for the same parameters'.
        fitted_rad: RMS of the residual where the fit of all was made [rad].
        unfitted_rad: That of each half under the parameters of the other [rad].
        by_session: Whether these are a session and the others, instead of halves.
    """

    p: float
    fitted_rad: float
    unfitted_rad: float
    by_session: bool = False


@dataclass(frozen=True)
class LackOfFit:
    """Whether the twin fits.

    Attributes:
        joints: Joint to what is left there.
        unfitted: The halves; None where one is too short.
        gaits_hz: Frequencies that were looked at, of the sessions that have a steady gait.
    """

    joints: dict[str, JointFit]
    unfitted: Unfitted | None
    alternatives: tuple[Alternative, ...]
    gaits_hz: tuple[float, ...]

    @property
    def p(self) -> float:
        """Of 'the twin fits', family-wise over joints, other laws and all checks."""
        checks = [len(self.joints) * min(joint.p for joint in self.joints.values())]
        if self.unfitted is not None:
            checks.append(self.unfitted.p)
        kinds = (
            [alternative.p for alternative in self.alternatives if alternative.widens is laws]
            for laws in (True, False)
        )
        checks += [len(others) * min(others) for others in kinds if others]
        return min(1.0, len(checks) * min(checks))

    @property
    def significant(self) -> bool:
        """Whether the twin is shown not to fit."""
        return self.p < LEVEL

    @property
    def explanation(self) -> Alternative | None:
        """What explains most of the misfit, if something is shown that may be named."""
        shown = [
            other
            for other in self.alternatives
            if other.could_explain
            and other.p * sum(a.widens is other.widens for a in self.alternatives) < LEVEL
        ]
        return min(shown, key=lambda other: other.left, default=None)

    @property
    def worst(self) -> str:
        """The joint that fits worst."""
        joints = self.joints
        return min(joints, key=lambda j: (joints[j].p, -(joints[j].periodic_rad or 0.0)))


def lack_of_fit(
    measured: MeasuredAngles,
    residuals: Sequence[FloatArray],
    omegas: Sequence[float | None],
    unfitted: Unfitted | None,
    others: tuple[Alternative, ...] = (),
) -> LackOfFit:
    """Test what a fit has left.

    Args:
        measured: Angles of r joints.
        residuals: [rad], shapes (n_j,).
        omegas: Of each joint's gait [rad/s]; None where there is none.
        unfitted: From :func:`halves`.
        others: From :func:`.replay.calibrate.identifiability.alternatives`.
    """
    fits: dict[str, JointFit] = {}
    rows = zip(measured.joints, measured.times_s, measured.angles, residuals, omegas, strict=True)
    for joint, t, angle, rest, omega in rows:
        if omega is not None and float(t[-1] - t[0]) * omega / (2 * np.pi) >= FEWEST_CYCLES:
            fits[joint] = periodic(t, rest, omega, step_of(angle))
        else:
            fits[joint] = JointFit(ljung_box(rest), None)
    gaits = tuple({omega / (2 * np.pi): None for omega in omegas if omega is not None})
    return LackOfFit(fits, unfitted, others, gaits)


def periodic(t: FloatArray, residual: FloatArray, omega: float, step: float = 0.0) -> JointFit:
    """Test the power at the gait's harmonics against that between them.

    Args:
        t: Times [s], shape (n,).
        residual: Shape (n,).
        omega: Of the gait [rad/s].
        step: Of the encoder [rad]; rounding comes back every cycle, too, where samples do.

    Returns:
        p, and the RMS of the periodic part.
    """
    t = t - t.mean()
    duration = float(t[-1] - t[0])
    rate = t.size / duration
    cycles = duration * omega / (2 * np.pi)
    most = max(1, min(HARMONICS, int(0.4 * rate * 2 * np.pi / omega)))
    trend = np.stack([np.ones_like(t), t], axis=1)
    lines = [_waves(t, k * omega) for k in range(1, most + 1)]
    whole = np.linalg.qr(np.hstack([trend, *lines]))[0]
    rest = residual - whole @ (whole.T @ residual)
    reach = min(BETWEEN, int((cycles - 1) / 2))
    statistic, power = 0.0, 0.0
    for k in range(1, most + 1):
        at_line = _power(residual, lines[k - 1], np.hstack([trend, *lines[: k - 1], *lines[k:]]))
        near = [
            _power(rest, _waves(t, k * omega + 2 * np.pi * d / duration), whole)
            for d in range(-reach, reach + 1)
            if d != 0 and k * cycles + d >= 1
        ]
        # What rounding may put there, evenly over the harmonics of half a sampling rate.
        level = max(float(np.mean(near)), t.size * step**2 / 12 * 2 / max(rate / omega, 2.0))
        power += max(0.0, at_line - level)
        p = float(fdtrc(2, 2 * len(near), at_line / level)) if level > 0 else 1.0
        statistic -= 2 * np.log(max(p, 1e-300))
    return JointFit(float(chdtrc(2 * most, statistic)), float(np.sqrt(power / t.size)))


def step_of(angles: FloatArray) -> float:
    """Step of the encoder, as far as its values show it.

    Args:
        angles: [rad], shape (n,).

    Returns:
        The smallest step between values [rad]; 0 where hardly any value comes twice.
    """
    values = np.unique(np.round(angles, 12))
    return float(np.min(np.diff(values))) if 1 < values.size < angles.size / 2 else 0.0


def ljung_box(residual: FloatArray) -> float:
    """Test whether a residual is noise of a first-order memory.

    Args:
        residual: At even intervals, shape (n,).

    Returns:
        p.
    """
    n = residual.size
    centred = residual - residual.mean()
    phi = float(centred[1:] @ centred[:-1]) / max(float(centred @ centred), 1e-300)
    left = centred[1:] - phi * centred[:-1]
    count = min(LAGS, n // 5)
    if count < 2:
        return 1.0
    whole = max(float(left @ left), 1e-300)
    rho = np.array([float(left[k:] @ left[:-k]) / whole for k in range(1, count + 1)])
    statistic = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, count + 1))))
    return float(chdtrc(count - 1, statistic))


def halves(problem: LeastSquares, x: FloatArray, sessions: Sequence[int] = ()) -> Unfitted | None:
    """Fit a part of what was recorded by itself, and predict the rest; and the other way round.

    The parts are the halves of each series; of several sessions, also each session and the others.

    Args:
        problem: What the fit of all leaves.
        x: That fit, shape (K,).
        sessions: Number of each series' session; all the same if empty.

    Returns:
        The pair of parts that agrees least, its p family-wise; None where half of what there is is
        too short for K parameters.
    """
    count = len(x)
    lengths = list(map(len, problem.residuals))
    pairs = [(_part(problem, a), _part(problem, b)) for a, b in _pairs(lengths, sessions)]
    long_enough = [pair for pair in pairs if min(_size(part) for part in pair) > 4 * count]
    if not long_enough or not count:
        return None
    compared = [_compared(*pair, x) for pair in long_enough]
    p, unfitted_rad = min(compared)
    by_session = pairs[0] is not long_enough[compared.index((p, unfitted_rad))]
    fitted_rad = _rms(problem.residuals)
    return Unfitted(min(1.0, len(compared) * p), fitted_rad, unfitted_rad, by_session)


def _pairs(lengths: Sequence[int], sessions: Sequence[int]) -> Iterator[tuple[_Slices, _Slices]]:
    """Yield pairs of parts, a slice of each series: halves, then a session and the others."""
    yield [slice(n // 2) for n in lengths], [slice(n // 2, None) for n in lengths]
    numbers = sorted(set(sessions))
    for number in numbers if len(numbers) > 2 else numbers[1:]:
        within = [slice(None if k == number else 0) for k in sessions]
        yield within, [slice(0 if k == number else None) for k in sessions]


def _part(problem: LeastSquares, slices: _Slices) -> LeastSquares:
    """The problem of a part; where an encoder has its zero is the part's own affair, too."""
    rows = zip(problem.columns, problem.residuals, problem.sigma.tolist(), slices, strict=True)
    parts = [(c[s], r[s], deviation) for c, r, deviation, s in rows if len(r[s])]
    return LeastSquares(
        [c - c.mean(axis=0) for c, _, _ in parts],
        [r - r.mean() for _, r, _ in parts],
        np.array([deviation for _, _, deviation in parts]),
        problem.precision,
    )


def _size(part: LeastSquares) -> int:
    return sum(map(len, part.residuals))


def _compared(first: LeastSquares, second: LeastSquares, x: FloatArray) -> tuple[float, float]:
    """Return p of 'both ask for the same parameters', and the RMS under the other's [rad]."""
    prior = np.diag(first.precision)
    steps: list[FloatArray] = []
    inverses: list[FloatArray] = []
    covariance = np.zeros_like(prior)
    for part in (first, second):
        normal = part.normal
        inverse: FloatArray = np.linalg.inv(normal).astype(np.float64)
        # Never less than white noise has it, as in the fit itself.
        covariance += inverse @ larger(part.scores(), normal - prior) @ inverse
        steps.append(inverse @ (part.slope - part.precision * x))
        inverses.append(inverse)
    apart = inverses[0] - inverses[1]
    covariance += apart @ prior @ apart
    difference = steps[0] - steps[1]
    scale = np.sqrt(np.diag(covariance))
    scaled = difference / scale
    statistic = float(scaled @ np.linalg.pinv(covariance / np.outer(scale, scale)) @ scaled)
    unfitted = [
        r - c @ step
        for part, step in ((first, steps[1]), (second, steps[0]))
        for r, c in zip(part.residuals, part.columns, strict=True)
    ]
    return float(chdtrc(len(x), statistic)), _rms(unfitted)


def _waves(t: FloatArray, omega: float) -> FloatArray:
    return np.stack([np.cos(omega * t), np.sin(omega * t)], axis=1)


def _power(values: FloatArray, waves: FloatArray, others: FloatArray) -> float:
    """Sum of squares that two waves explain beyond the others."""
    basis = np.linalg.qr(others)[0]
    remainder = np.linalg.qr(waves - basis @ (basis.T @ waves))[0]
    return float(np.sum((remainder.T @ values) ** 2))


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(list(parts)) ** 2)))
