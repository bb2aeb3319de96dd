"""Noise at the gait frequency, from the residual's spectrum beside it.

A white-noise bound needs the noise to be white, a bootstrap over cycles needs many cycles. What
the error of an amplitude really is made of is the noise power in the narrow band around omega,
and the residual shows that band: the periodogram in L bins on both sides of omega, omega itself
left out because the fit has removed it (Welch's averaging of periodograms over frequency, e.g.
Percival & Walden, Spectral Analysis for Physical Applications, 1993, section 6). Averaging
symmetric bins cancels the slope of a coloured spectrum. Each bin has two degrees of freedom, so
Student's t with 2 L of them gives the interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture.arrays import ComplexArray, FloatArray, IntArray

from .harmonic import HarmonicFit
from .harmonic_moments import (
    RELATIVE_FLOOR,
    HarmonicModel,
    basis,
    chunks,
    time_scale,
)
from .series import Series, shared_times
from .threads import in_threads

BINS_PER_SIDE = 6
"""At most six bins on either side: 24 degrees of freedom, whose t factor is 5 % above normal."""

_BLOCKS = 4096

KEPT_POWER = 0.5
"""A bin of which the fit has removed more than half says too little about the noise."""


@dataclass(frozen=True)
class Noise:
    """Noise of the fitted fundamental of K channels.

    Attributes:
        level: Variance per sample that white noise of the same power at omega would have, in the
            channel's unit squared, shape (K,).
        dof: Degrees of freedom of ``level``, shape (K,).
        covariance: Of (Re a, Im a) of the fundamental, shape (K, 2, 2).
    """

    level: FloatArray
    dof: FloatArray
    covariance: FloatArray

    def along(self, direction: ComplexArray) -> FloatArray:
        """Variance of each fundamental along a direction of the complex plane.

        Args:
            direction: Unit complex numbers, shape (K,).

        Returns:
            Variances, shape (K,).
        """
        unit = np.stack([direction.real, direction.imag], axis=-1)
        return np.einsum("ki,kij,kj->k", unit, self.covariance, unit)


def bins_per_side(cycles: float) -> int:
    """How many bins beside omega are used.

    They stay within the inner two thirds of the band between zero and the second harmonic, where
    neither the constant nor a harmonic has taken the noise away.

    Args:
        cycles: Cycles in the record.

    Returns:
        From 1 to ``BINS_PER_SIDE``.
    """
    return int(np.clip(round(2 * cycles / 3), 1, BINS_PER_SIDE))


def residual_noise(series: Sequence[Series], fit: HarmonicFit) -> Noise:
    """Noise of each channel's fundamental.

    The periodogram is a direct sum over the actual sampling times, so it needs no even grid. Each
    bin is divided by what the fit left of it, e^H (1 - Phi (Phi^T Phi)^-1 Phi^T) e, which makes
    the level unbiased for white noise also in a short record or one with gaps. An exact channel
    keeps the level of its rounding.

    Args:
        series: The channels that were fitted.
        fit: Their fit.

    Returns:
        Level, degrees of freedom and covariance.
    """
    level, dof = np.zeros((2, len(series)))

    def bins(members: list[int]) -> tuple[FloatArray, FloatArray]:
        return _bins([series[k] for k in members], fit, members)

    groups = shared_times(series)
    found = in_threads(bins, groups, sum(one.count for one in series))
    for members, (power, kept) in zip(groups, found, strict=True):
        usable = kept > KEPT_POWER * fit.count[members[0]]
        if not np.any(usable):
            usable = kept == kept.max()
        level[members] = np.mean(power[:, usable] / kept[usable], axis=1)
        dof[members] = 2.0 * np.count_nonzero(usable)
    level = np.maximum(level, RELATIVE_FLOOR * fit.total / np.maximum(fit.count, 1.0))
    first = fit.model.first
    block = fit.inverse_gram[:, first : first + 2, first : first + 2]
    return Noise(level, dof, level[:, None, None] * block)


def omega_variance(fit: HarmonicFit, noise: Noise) -> tuple[float, float]:
    """Variance of the shared frequency, from each channel's own noise.

    With information i, weight w and noise level s of each channel it is sum(w^2 i s) over
    sum(w i)^2; for white noise, where w s = 1, that is the inverse of the summed Fisher
    information (the multi-channel form of Rife & Boorstyn, IEEE Trans. Inf. Theory 20, 1974).

    Args:
        fit: Fit with a shared frequency.
        noise: Its noise.

    Returns:
        Variance [(rad/s)^2] and its degrees of freedom (Welch-Satterthwaite).
    """
    pull = fit.weight * fit.information
    total = float(np.sum(pull))
    if total == 0:
        return float("inf"), 1.0
    parts = fit.weight * pull * noise.level / total**2
    variance = float(np.sum(parts))
    dof = variance**2 / float(np.sum(parts**2 / noise.dof)) if variance > 0 else 1.0
    return variance, dof


@dataclass(frozen=True)
class Residual:
    """What a fit leaves of one chunk of a group of k channels.

    Attributes:
        part: Where in the record the chunk lies.
        rows: Basis rows of the model with one harmonic more, shape (p + 2, n).
        turned: Residual times cos(omega t) and times -sin(omega t), shape (2, k, n).
    """

    part: slice
    rows: FloatArray
    turned: FloatArray


def residuals(
    group: Sequence[Series], fit: HarmonicFit, members: Sequence[int]
) -> Iterator[Residual]:
    """What a fit leaves of channels with shared times, turned back by the gait's own rotation.

    Args:
        group: The channels.
        fit: The fit that holds them.
        members: Their indices in the fit.

    Yields:
        Chunk by chunk.
    """
    t_s = group[0].t_s
    scale = time_scale(t_s)
    theta = _parameters(fit, members, scale)
    first = fit.model.first
    wider = replace(fit.model, harmonics=fit.model.harmonics + 1)
    for part in chunks(t_s.size):
        rows = basis(t_s[part], fit.omega, wider, scale)
        residual = np.stack([one.values[part] for one in group])
        residual -= theta @ rows[: fit.model.size]
        yield Residual(part, rows, rows[first : first + 2, None] * residual)


def _bins(
    group: Sequence[Series], fit: HarmonicFit, members: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Residual power in each bin, shape (k, L), and what the fit left of a unit there, (L,)."""
    t_s = group[0].t_s
    span = float(t_s[-1] - t_s[0]) * t_s.size / max(t_s.size - 1, 1)
    side = bins_per_side(fit.omega * span / (2 * np.pi))
    transform = np.zeros((len(group), 2 * side), dtype=np.complex128)
    overlap = np.zeros((fit.model.size, 2 * side), dtype=np.complex128)
    # Demodulated, the bins turn a few times over the whole record: long records are summed in
    # blocks of less than a hundredth of a radian first.
    block = max(1, t_s.size // _BLOCKS)
    for one in residuals(group, fit, members):
        count = one.part.stop - one.part.start
        edges: IntArray = np.arange(0, count, block, dtype=np.int64)
        filled = np.diff(np.concatenate((edges, [count])))
        waves = _waves(np.add.reduceat(t_s[one.part], edges) / filled, 2 * np.pi / span, side)
        real, imaginary = np.add.reduceat(one.turned, edges, axis=2)
        transform += (real + 1j * imaginary) @ waves.T
        overlap += _turned_rows(one.rows, edges, fit.model) @ waves.T
    removed = np.einsum("pl,pq,ql->l", overlap.conj(), fit.inverse_gram[members[0]], overlap).real
    return np.abs(transform) ** 2, t_s.size - removed


def _turned_rows(rows: FloatArray, edges: IntArray, model: HarmonicModel) -> ComplexArray:
    """Sums over blocks of the basis rows times exp(-j omega t), shape (p, blocks).

    Of a harmonic they are those of its neighbours: cos(h x) exp(-j x) is half the sum of
    exp(j (h - 1) x) and exp(-j (h + 1) x), and -sin(h x) exp(-j x) is j / 2 of their difference.
    """
    first, h = model.first, model.harmonics
    sums = np.add.reduceat(rows, edges, axis=1)
    parts = sums[first:].reshape(h + 1, 2, -1)
    back: ComplexArray = parts[:, 0] + 1j * parts[:, 1]  # exp(-j m x), m = 1 .. h + 1
    below = np.concatenate((sums[:1], back[: h - 1].conj()))
    turned = np.empty((model.size, edges.size), dtype=np.complex128)
    turned[0] = back[0]
    for d in range(1, first):
        real, imaginary = np.add.reduceat(rows[d] * rows[first : first + 2], edges, axis=1)
        turned[d] = real + 1j * imaginary
    turned[first::2] = (below + back[1:]) / 2
    turned[first + 1 :: 2] = (below - back[1:]) * 0.5j
    return turned


def _waves(t_s: FloatArray, spacing: float, side: int) -> ComplexArray:
    """exp(-j nu t) at nu = +- k spacing, k = 1 .. side; shape (2 side, n)."""
    turn = np.exp(-1j * spacing * t_s)
    waves = np.empty((2 * side, t_s.size), dtype=np.complex128)
    up: ComplexArray = np.ones_like(turn)
    for k in range(side):
        up = up * turn
        waves[2 * k], waves[2 * k + 1] = up, up.conj()
    return waves


def _parameters(fit: HarmonicFit, members: Sequence[int], scale: float) -> FloatArray:
    """Coefficients of the basis rows, shape (k, p)."""
    trend = fit.trend[members] * scale ** np.arange(fit.model.trend + 1.0)
    parts = np.concatenate([fit.lines[members], fit.amplitudes[members]], axis=1)
    harmonic = np.stack([parts.real, parts.imag], axis=-1).reshape(len(members), -1)
    return np.concatenate([trend, harmonic], axis=1)
