"""Motion without commands: from joint angles to amplitudes, lags and the wave along a chain.

Phases phi_k = arg a_k of the joints at places x_k are fitted by a line, phi = phi_0 - kappa x, with
weights |a_k|^2. Where all joints have the same white noise that is maximum likelihood and reaches
the Cramer-Rao bound; and where the phases aren't on a line, the slope is the same whatever the
noise. The slope kappa is a contrast of the phases, so its interval comes from the same bins of the
residual as that of any other contrast (:mod:`.analysis.estimators.intervals`), whatever noise the
joints share.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from ...common.estimate import Estimate, Interval
from ...estimators.harmonic import HarmonicFit, fit_at
from ...estimators.intervals import CONFIDENCE, around, t_factor
from ...estimators.series import Series
from ...estimators.spectrum import ResidualBins, residual_spectrum
from ...response.fitting import GaitFit

_GRID = 16
"""Trial wave numbers for each joint; the peak's width is one over the number of joints."""


@dataclass(frozen=True)
class Oscillation:
    """m joints that move at one frequency.

    Attributes:
        amplitudes: Complex amplitudes at t = 0 [rad], shape (m,).
        bins: Their residuals beside the frequency.
        mean_time_s: Mean sampling time of each, shape (m,).
        omega_variance: Of the common angular frequency [(rad/s)^2].
    """

    amplitudes: ComplexArray
    bins: ResidualBins
    mean_time_s: FloatArray
    omega_variance: float

    @property
    def dof(self) -> float:
        """Degrees of freedom of what the bins show."""
        return 2.0 * self.bins.values.shape[1]

    def select(self, index: IntArray) -> Oscillation:
        """Return some of the joints, in the order of their indices."""
        parts = self.amplitudes[index], self.bins.select(index), self.mean_time_s[index]
        return Oscillation(*parts, self.omega_variance)

    def covariance(self, factors: ComplexArray) -> FloatArray:
        """Return the covariance of p numbers Re sum_k factor_k da_k, da_k the amplitudes' errors.

        Args:
            factors: In the numbers' unit over that of the amplitudes, shape (p, m).

        Returns:
            Shape (p, p).
        """
        shown = (factors * np.sqrt(self.bins.spread)) @ self.bins.values
        parts = np.stack([factors.real, -factors.imag], axis=-1)
        rounding = np.einsum("pki,kij,qkj->pq", parts, self.bins.rounding, parts)
        return (shown @ shown.conj().T).real / (2 * shown.shape[1]) + rounding

    def error(self, factor: ComplexArray) -> float:
        """Return the standard error of Re sum_k factor_k da_k, factor of shape (m,)."""
        return float(self.covariance(factor[None])[0, 0]) ** 0.5

    def turn(self, weight: FloatArray) -> float:
        """Return the error of sum_k weight_k arg a_k that the frequency's error makes [rad].

        Args:
            weight: Shape (m,).
        """
        return abs(float(weight @ self.mean_time_s)) * self.omega_variance**0.5

    def known_phases(self) -> BoolArray:
        """Which joints have a phase: noise leaves their amplitude distinct from zero, (m,)."""
        size = np.abs(self.amplitudes)
        errors = np.sqrt(np.diag(self.covariance(np.eye(size.size, dtype=np.complex128))))
        return size > t_factor(self.dof) * errors


def amplitude(motion: Oscillation, row: int) -> tuple[float, float]:
    """Return the amplitude of a joint and its standard error [rad]."""
    size = float(np.abs(motion.amplitudes[row]))
    factor = np.zeros(motion.amplitudes.size, dtype=np.complex128)
    factor[row] = np.conj(motion.amplitudes[row]) / size if size > 0 else 1.0
    return size, motion.error(factor)


def phase_lag(motion: Oscillation, joint: int, before: int) -> tuple[Estimate, float]:
    """Return the lag of a joint behind another, and its standard error [rad].

    Args:
        joint: A joint with a known phase; so is ``before``.

    Returns:
        The lag in (-pi, pi], empty where noise leaves it open.
    """
    lag = float(-np.angle(motion.amplitudes[joint] / motion.amplitudes[before]))
    weight = np.zeros(motion.amplitudes.size)
    weight[[joint, before]] = -1.0, 1.0
    factor = np.zeros(motion.amplitudes.size, dtype=np.complex128)
    np.divide(weight, 1j * motion.amplitudes, out=factor, where=weight != 0)
    # d arg a = Im(da / a)
    error = float(np.hypot(motion.error(factor), motion.turn(weight)))
    sine = t_factor(motion.dof) * error
    if not sine < 1:
        return Estimate(), error
    return Estimate(lag, around(lag, float(np.arcsin(sine)))), error


@dataclass(frozen=True)
class PhaseLine:
    """A line through the phases of m joints.

    Attributes:
        slope: kappa [rad/unit of the places]; its interval holds how far the phases are off a line.
        error: Its standard error by noise.
        deviation_rad: Root mean square of the phases about it, weighted.
        phases_rad: The phases, unwrapped along the chain, shape (m,).
        straight: Whether noise explains how far the phases are off it.
    """

    slope: Estimate
    error: float
    deviation_rad: float
    phases_rad: FloatArray
    straight: bool


def phase_line(
    motion: Oscillation, index: FloatArray, place: FloatArray, near_rad: FloatArray | None = None
) -> PhaseLine:
    """Fit a line to the phases.

    Args:
        motion: m joints with known phases, m > 1.
        index: Number of each in the chain, ascending; the phase between neighbours is known up to
            whole turns, and the fit takes the lag nearest to the mean one.
        place: Place of each along the chain, in any unit, shape (m,).
        near_rad: Unwrapped phases, shape (m,); lags are taken nearest to theirs instead, so that
            lines of several motions are of the same turns.
    """
    weight = np.abs(motion.amplitudes) ** 2
    weight = weight / weight.sum()
    phase = np.angle(motion.amplitudes)
    steps = (
        -best_lag(phase, index, weight) * np.diff(index) if near_rad is None else np.diff(near_rad)
    )
    phase = _unwrapped(phase, steps)
    centred = place - weight @ place
    contrast = -weight * centred / (weight @ centred**2)
    slope = float(contrast @ phase)
    left = phase - weight @ phase + slope * centred
    # d kappa = contrast (Im(da / a) + 2 left Re(da / a)): amplitudes are the weights.
    noise = motion.error(contrast * (2 * left - 1j) / motion.amplitudes)
    error = float(np.hypot(noise, motion.turn(contrast)))
    misfit = _misfit(contrast * left, noise, motion.dof)
    interval = around(slope, float(np.hypot(t_factor(motion.dof) * error, misfit)))
    deviation_rad = float(weight @ left**2) ** 0.5
    return PhaseLine(Estimate(slope, interval), error, deviation_rad, phase, misfit == 0)


def local_wave_numbers(
    motion: Oscillation, index: FloatArray, phases_rad: FloatArray
) -> list[Estimate]:
    """Return the wave number between each joint and the next [rad/joint].

    Args:
        motion: m joints with known phases.
        index: Number of each in the chain, shape (m,).
        phases_rad: Their unwrapped phases, shape (m,).

    Returns:
        m - 1 estimates, each with its own 95 % interval; empty where noise leaves the lag open.
    """
    numbers: list[Estimate] = []
    for k, joints in enumerate(np.diff(index).tolist()):
        lag, _ = phase_lag(motion, k + 1, k)
        if lag.value is None or lag.ci95 is None:
            numbers.append(Estimate())
            continue
        half = (lag.ci95[1] - lag.ci95[0]) / 2
        number = float(phases_rad[k] - phases_rad[k + 1]) / joints
        numbers.append(Estimate(number, around(number, half / joints)))
    return numbers


def _misfit(shares: FloatArray, noise: float, dof: float) -> float:
    """Return what phases off the line add to half of the slope's interval.

    Args:
        shares: What each phase's distance from the line adds to the slope, shape (m,).
        noise: Standard error of the slope by noise.
        dof: Its degrees of freedom.

    Returns:
        0 where the noise explains them, by an F test.
    """
    freedom = shares.size - 2
    if freedom < 1:
        return 0.0
    variance = float(shares @ shares) * shares.size / freedom
    if variance <= noise**2 * float(fdtri(freedom, dof, CONFIDENCE)):
        return 0.0
    return t_factor(float(freedom)) * (variance - noise**2) ** 0.5


def best_lag(phase: FloatArray, index: FloatArray, weight: FloatArray) -> float:
    """Return the lag from joint to joint of the wave that fits best, on a grid [rad].

    Args:
        phase: Of the joints [rad], shape (m,).
        index: Number of each in the chain, shape (m,).
        weight: Shape (m,).
    """
    count = _GRID * (int(index[-1] - index[0]) + 1)
    trial = np.linspace(-np.pi, np.pi, count, endpoint=False)
    sums = np.abs((weight * np.exp(1j * phase)) @ np.exp(1j * np.outer(index, trial)))
    return float(trial[np.argmax(sums)])


def _unwrapped(phase: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the phases with each step as near to the given one as whole turns allow."""
    off = np.angle(np.exp(1j * (np.diff(phase) - steps)))
    return phase[0] + np.concatenate(([0.0], np.cumsum(off + steps, dtype=np.float64)))


def travelling_index(motion: Oscillation) -> tuple[Estimate, float]:
    """Return how much of a wave travels: 1 of a travelling, 0 of a standing one.

    The complex amplitudes c + j d span a plane of shapes; with s1 >= s2 the singular values of the
    matrix of c and d, the index is s2 / s1, one over its condition number (Feeny 2008). An error E
    of the matrix changes s by u^T E v to first order. Of a standing wave s2 is all noise: the
    length of E v2 across u1, whose square is compared with its mean by an F test (degrees of
    freedom after Satterthwaite).

    Args:
        motion: At least two joints.

    Returns:
        The index and its standard error; its interval reaches to 0 where s2 can't be told from
        noise.
    """
    a = motion.amplitudes
    left, size, right = np.linalg.svd(np.stack([a.real, a.imag], axis=-1), full_matrices=False)
    if size[0] == 0:
        return Estimate(), 0.0
    # u^T E v = Re sum_k u_k conj(v) da_k, with v as a complex number.
    turned = right[:, 0] - 1j * right[:, 1]
    small, large = left[:, 1] * turned[1], left[:, 0] * turned[0]
    index = float(size[1] / size[0])
    error = motion.error((small - index * large) / size[0])
    half = t_factor(motion.dof) * error
    across = np.eye(a.size) - np.outer(left[:, 0], left[:, 0])
    noise = motion.covariance(across * turned[1])
    power = float(np.trace(noise))
    freedom = power**2 / float(np.sum(noise**2)) if power > 0 else 1.0
    alone = size[1] ** 2 <= power * float(fdtri(freedom, motion.dof, CONFIDENCE))
    low = 0.0 if alone else max(0.0, index - half)
    return Estimate(index, (low, min(1.0, index + half))), error


@dataclass(frozen=True)
class MotionFit:
    """Joint angles fitted at the frequency that they share; heavy.

    Attributes:
        series: Angles of the m joints that are not constant, in chain order.
        fit: Their harmonics, in this order.
        oscillation: Their fundamentals, with errors.
        chain: Names of these joints and of those whose angles are constant, in chain order.
        omega_dof: Degrees of freedom of the variance of the frequency.
    """

    series: tuple[Series, ...]
    fit: HarmonicFit
    oscillation: Oscillation
    chain: tuple[str, ...]
    omega_dof: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints that are not constant."""
        return tuple(series.name for series in self.series)


def fit_motion(angles: Mapping[str, Series], gait: GaitFit) -> MotionFit | None:
    """Fit joint angles at their common frequency.

    Args:
        angles: Joint angles by name, in chain order.
        gait: Its frequency, found from the same angles.

    Returns:
        The fit; None where no joint moves.
    """
    enough = [angle for angle in angles.values() if angle.count > gait.fit.model.size + 1]
    series = [angle for angle in enough if np.ptp(angle.values) > 0]
    if not series:
        return None
    fit = fit_at(series, gait.fit.omega, gait.fit.model)
    _, bins = residual_spectrum(series, fit)
    return MotionFit(
        series=tuple(series),
        fit=fit,
        oscillation=Oscillation(fit.fundamental, bins, fit.mean_time_s, gait.omega_error**2),
        chain=tuple(angle.name for angle in enough),
        omega_dof=gait.omega_dof,
    )


def absolute(ends: Interval) -> Interval:
    """Return the interval of the absolute value."""
    low, high = sorted(map(abs, ends))
    return (0.0 if ends[0] <= 0 <= ends[1] else low), high


def wave_speed(slope: Estimate, omega: float) -> Estimate:
    """Return omega / |kappa|; empty where kappa may be zero.

    The error of the frequency is left out: it is smaller by the number of cycles.
    """
    low, high = absolute(slope.ci95 or (0.0, 0.0))
    if slope.value is None or low == 0:
        return Estimate()
    return Estimate(omega / abs(slope.value), (omega / high, omega / low))
