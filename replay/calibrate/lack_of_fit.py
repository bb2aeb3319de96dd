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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from undulog.capture.common.arrays import FloatArray

from .identifiability import Alternative
from .parameters import Measured
from .solve import LeastSquares, deviations

_STILL = 1e-3  # a joint that moves less has no gain [rad, RMS]


@dataclass(frozen=True)
class Misfit:
    """One joint.

    Attributes:
        rms: Of measured minus twin [rad].
        gain: g, positive where the robot moves more than the twin; None of a joint that is still.
        late_s: d [s], positive where the robot is later; likewise.
    """

    rms: float
    gain: float | None = None
    late_s: float | None = None


def misfit(times_s: FloatArray, measured: FloatArray, twin: FloatArray) -> Misfit:
    """Hold one joint against the twin's.

    Args:
        times_s: Sampling times [s], shape (n,).
        measured: Less the mean [rad], shape (n,).
    """
    rms = float(np.sqrt(np.mean((measured - twin) ** 2)))
    if np.sqrt(np.mean(twin**2)) < _STILL or np.unique(times_s).size < times_s.size:
        return Misfit(rms)
    rate = np.gradient(twin, times_s)
    along, late = np.linalg.lstsq(np.stack([twin, rate - rate.mean()], axis=1), measured)[0]
    return Misfit(rms, float(along - 1.0), float(-late / along))


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
    """Halves of the session that predict each other.

    Attributes:
        p: Of 'both halves ask for the same parameters'.
        fitted_rad: RMS of the residual where the fit of all was made [rad].
        unfitted_rad: That of each half under the parameters of the other [rad].
    """

    p: float
    fitted_rad: float
    unfitted_rad: float


@dataclass(frozen=True)
class LackOfFit:
    """Whether the twin fits.

    Attributes:
        joints: Joint to what is left there.
        unfitted: The halves; None where one is too short.
        gait_hz: Frequency that was looked at; None where there is no steady gait.
    """

    joints: dict[str, JointFit]
    unfitted: Unfitted | None
    alternatives: tuple[Alternative, ...]
    gait_hz: float | None

    @property
    def p(self) -> float:
        """Of 'the twin fits', family-wise over joints, other laws and all checks."""
        checks = [len(self.joints) * min(one.p for one in self.joints.values())]
        if self.unfitted is not None:
            checks.append(self.unfitted.p)
        kinds = (
            [one.p for one in self.alternatives if one.widens is laws] for laws in (True, False)
        )
        checks += [len(others) * min(others) for others in kinds if others]
        return min(1.0, len(checks) * min(checks))

    @property
    def found(self) -> bool:
        """Whether the twin is shown not to fit."""
        return self.p < LEVEL

    @property
    def worst(self) -> str:
        """The joint that fits worst."""
        joints = self.joints
        return min(joints, key=lambda j: (joints[j].p, -(joints[j].periodic_rad or 0.0)))


def lack_of_fit(
    measured: Measured,
    residuals: Sequence[FloatArray],
    omega: float | None,
    unfitted: Unfitted | None,
    others: tuple[Alternative, ...] = (),
) -> LackOfFit:
    """Test what a fit has left.

    Args:
        measured: Angles of r joints.
        residuals: [rad], shapes (n_j,).
        omega: Of the gait [rad/s]; None where there is none.
        unfitted: From :func:`halves`.
        others: From :func:`.replay.calibrate.identifiability.alternatives`.
    """
    found: dict[str, JointFit] = {}
    rows = zip(measured.joints, measured.times_s, measured.angles, residuals, strict=True)
    for joint, t, angle, rest in rows:
        if omega is not None and float(t[-1] - t[0]) * omega / (2 * np.pi) >= FEWEST_CYCLES:
            found[joint] = periodic(t, rest, omega, step_of(angle))
        else:
            found[joint] = JointFit(ljung_box(rest), None)
    return LackOfFit(found, unfitted, others, None if omega is None else omega / (2 * np.pi))


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


def halves(
    columns: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    x: FloatArray,
    precision: FloatArray,
) -> Unfitted | None:
    """Fit each half by itself, and predict the other.

    Args:
        columns: Derivatives of the twin's angles at the fit, shapes (n_j, K).
        residuals: [rad], shapes (n_j,).
        x: The fit, shape (K,).
        precision: Diagonal of the prior's inverse covariance, shape (K,).

    Returns:
        The check; None where half of the session is too short for K parameters.
    """
    count = len(x)
    middle = min(map(len, residuals)) // 2
    parts = [slice(None, middle), slice(middle, None)]
    if sum(len(r[parts[0]]) for r in residuals) <= 4 * count or not count:
        return None
    sigma = deviations(residuals)
    prior = np.diag(precision)
    steps: list[FloatArray] = []
    inverses: list[FloatArray] = []
    covariance = np.zeros((count, count))
    for part in parts:
        # Where an encoder has its zero is a half's own affair, too.
        J = [column[part] - column[part].mean(axis=0) for column in columns]
        rest = [r[part] - r[part].mean() for r in residuals]
        half = LeastSquares(J, rest, sigma, precision)
        normal = half.normal
        inverse: FloatArray = np.linalg.inv(normal).astype(np.float64)
        # Never less than white noise has it, as in the fit itself.
        covariance += inverse @ _larger(half.scores(), normal - prior) @ inverse
        steps.append(inverse @ (half.slope - precision * x))
        inverses.append(inverse)
    apart = inverses[0] - inverses[1]
    covariance += apart @ prior @ apart
    difference = steps[0] - steps[1]
    scale = np.sqrt(np.diag(covariance))
    scaled = difference / scale
    statistic = float(scaled @ np.linalg.pinv(covariance / np.outer(scale, scale)) @ scaled)
    unfitted = [
        (r[part] - r[part].mean()) - (c[part] - c[part].mean(axis=0)) @ steps[other]
        for part, other in zip(parts, (1, 0), strict=True)
        for r, c in zip(residuals, columns, strict=True)
    ]
    return Unfitted(float(chdtrc(count, statistic)), _rms(residuals), _rms(unfitted))


def _larger(scores: FloatArray, white: FloatArray) -> FloatArray:
    """The larger of two covariances, direction by direction."""
    values, vectors = np.linalg.eigh(white + 1e-12 * np.trace(white) * np.eye(len(white)))
    root = vectors * np.sqrt(values)
    back = vectors / np.sqrt(values)
    share, turn = np.linalg.eigh(back.T @ scores @ back)
    spread = root @ turn
    return (spread * np.maximum(share, 1.0)) @ spread.T


def _waves(t: FloatArray, omega: float) -> FloatArray:
    return np.stack([np.cos(omega * t), np.sin(omega * t)], axis=1)


def _power(values: FloatArray, waves: FloatArray, others: FloatArray) -> float:
    """Sum of squares that two waves explain beyond the others."""
    basis = np.linalg.qr(others)[0]
    own = np.linalg.qr(waves - basis @ (basis.T @ waves))[0]
    return float(np.sum((own.T @ values) ** 2))


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(list(parts)) ** 2)))
