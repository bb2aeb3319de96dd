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

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from undulog.capture.common.process import in_threads
from undulog.capture.judgement.levels import ROBUST, TAME

from .harmonic import RELATIVE_FLOOR, HarmonicFit, HarmonicModel, basis, chunks, time_scale
from .quantisation import (
    DRAWS,
    draws,
    hysteresis_covariance,
    lattice_step,
    not_negative,
    rounding_covariance,
    some_samples,
    steady_noise,
)
from .series import Series, shared_times

BINS_PER_SIDE = 6
"""At most six bins on either side: 24 degrees of freedom, whose t factor is 5 % above normal."""

_BLOCKS = 4096

_LOOKED_AT = 4096
"""Samples by which the course of noise over a cycle is known to 5 %."""

_LARGEST = (TAME * ROBUST) ** 2
"""Largest square of a residual, in median ones."""

RAISED = 1.3
"""Rounding that alone makes this many times the noise found beside omega counts instead of it."""

SAME_SPAN = 1.05
"""Records whose lengths differ by no more than this factor have the same bins."""

KEPT_POWER = 0.5
"""A bin of which the fit has removed more than half says too little about the noise."""


@dataclass(frozen=True)
class FundamentalNoise:
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
        """Return the variance of each fundamental along a direction of the complex plane.

        Args:
            direction: Unit complex numbers, shape (K,).

        Returns:
            Variances, shape (K,).
        """
        unit = np.stack([direction.real, direction.imag], axis=1)
        return np.einsum("ki,kij,kj->k", unit, self.covariance, unit)


def bins_per_side(cycles: float) -> int:
    """How many bins beside omega are used.

    They stay within the inner two thirds of the band between zero and the second harmonic, where
    neither the constant nor a harmonic has taken the noise away.

    Returns:
        From 1 to ``BINS_PER_SIDE``.
    """
    return int(np.clip(round(2 * cycles / 3), 1, BINS_PER_SIDE))


@dataclass(frozen=True)
class ResidualBins:
    """Demodulated residuals of K channels in L bins beside omega, which all channels share.

    Bin l of channel k is sum_n e_k(t_n) exp(-j (omega + nu_l) t_n), over the root of what the fit
    left of a unit there. t is true time from the common origin, so products between channels are
    cross spectra, also between channels that were sampled at different times or rates.

    Attributes:
        values: In the channel's unit, shape (K, L). The mean of |value|^2 over the bins is the
            channel's noise level: the variance per sample of white noise of the same power.
        offset: nu_l [rad/s], in pairs +nu, -nu, shape (L,).
        spread: Trace of the covariance of (Re a, Im a) for a level of one, shape (K,): the mean
            of ``spread |value|^2`` is E|error of a|^2.
        rounding: Covariance of (Re a, Im a) that rounding, to steps or of numbers, adds to what
            the bins show, shape (K, 2, 2); it is counted as each channel's own.
        steps: The same by rounding to steps, and by a reading's hysteresis, alone, whatever the
            bins show; None for zero.
    """

    values: ComplexArray
    offset: FloatArray
    spread: FloatArray
    rounding: FloatArray
    steps: FloatArray | None = None

    def select(self, chosen: Sequence[int] | IntArray) -> ResidualBins:
        """Some of the channels.

        Args:
            chosen: Indices, k of them; an index may come more than once.
        """
        index = np.asarray(chosen, dtype=np.int64)
        steps = None if self.steps is None else self.steps[index]
        chosen_rows = (self.spread[index], self.rounding[index], steps)
        return ResidualBins(self.values[index], self.offset, *chosen_rows)


def residual_noise(series: Sequence[Series], fit: HarmonicFit) -> FundamentalNoise:
    """Return the noise of each channel's fundamental.

    The periodogram is a direct sum over the actual sampling times, so it needs no even grid. Each
    bin is divided by what the fit left of it, e^H (1 - Phi (Phi^T Phi)^-1 Phi^T) e, which makes
    the level unbiased for white noise also in a short record or one with gaps. An exact channel
    keeps the level of its rounding.

    Args:
        series: The channels that were fitted.

    Returns:
        Level, degrees of freedom and covariance.
    """
    return residual_spectrum(series, fit)[0]


def residual_spectrum(
    series: Sequence[Series], fit: HarmonicFit
) -> tuple[FundamentalNoise, ResidualBins]:
    """Return the noise of each channel's fundamental, and the bins that it comes from.

    Bins lie whole multiples of 2 pi / T beside omega. For the bins that all channels share, T is
    the shortest channel's; the noise of a channel that is longer by more than ``SAME_SPAN`` comes
    from bins of its own.

    Args:
        series: The channels that were fitted.

    Returns:
        The noise, as from :func:`residual_noise`, and the common bins.
    """
    level, dof = np.zeros((2, len(series)))
    groups = shared_times(series)
    spans = {members[0]: _span(series[members[0]]) for members in groups}
    shortest = min(spans.values())

    def demodulated(members: list[int]) -> tuple[_Demodulated, _Demodulated]:
        group = [series[k] for k in members]
        common = _demodulated(group, fit, members, shortest)
        if spans[members[0]] <= SAME_SPAN * shortest:
            return common, common
        return common, _demodulated(group, fit, members, spans[members[0]])

    spectra = in_threads(demodulated, groups, sum(channel.count for channel in series))
    for members, (_, spectrum) in zip(groups, spectra, strict=True):
        usable = spectrum.usable()
        level[members] = np.mean(spectrum.power()[:, usable] / spectrum.kept[usable], axis=1)
        dof[members] = 2.0 * np.count_nonzero(usable)
    floor = np.maximum(RELATIVE_FLOOR * fit.total / fit.count - level, 0.0)
    level += floor
    first = fit.model.first
    block = fit.inverse_gram[:, first : first + 2, first : first + 2]
    spread = np.trace(block, axis1=1, axis2=2)
    noisy = np.flatnonzero(floor == 0).tolist()
    shapes = in_threads(lambda k: _modulated(series[k], fit, k), noisy, _LOOKED_AT * len(noisy))
    covariance = level[:, None, None] * block
    for k, shape in zip(noisy, shapes, strict=True):
        covariance[k] = level[k] * shape
    rounding = floor[:, None, None] * block
    steps = np.zeros_like(rounding)
    lattices = [lattice_step(channel.values) for channel in series]
    for k, rounded in _rounded(series, fit, level, lattices):
        steps[k] = rounded
        if np.trace(rounded) > RAISED * spread[k] * level[k]:
            more = not_negative(rounded - covariance[k])
            rounding[k] += more
            covariance[k] += more
            level[k] = np.trace(covariance[k]) / spread[k]
            dof[k] = draws(series[k].count)
    for k, step in enumerate(lattices):
        late = hysteresis_covariance(series[k], fit, k, step) if step > 0 else None
        if late is not None:
            for total in (covariance, rounding, steps):
                total[k] += late
    common = [common for common, _ in spectra]
    bins = _common_bins(groups, common, shortest, spread, rounding)
    return FundamentalNoise(level, dof, covariance), replace(bins, steps=steps)


def _modulated(channel: Series, fit: HarmonicFit, k: int) -> FloatArray:
    """Return the covariance of (Re a, Im a) for a noise level of one, shape (2, 2).

    Noise that grows with the motion is strongest where cos^2 is, and moves the amplitude more than
    the phase: each sample counts by its own square (White, Econometrica 48, 1980, doi
    10.2307/1912934). Squares are limited, so that a few samples of heavy tails don't decide it.
    """
    first = fit.model.first
    weight = fit.inverse_gram[k][first : first + 2]
    block: FloatArray = weight[:, first : first + 2]
    t_s, values = some_samples(channel, _LOOKED_AT)
    scale = time_scale(channel.t_s)
    rows = basis(t_s, fit.omega, fit.model, scale)
    squares = (values - fit.parameters([k], scale)[0] @ rows) ** 2
    squares = np.minimum(squares, _LARGEST * float(np.median(squares)))
    parts = weight @ rows
    shape: FloatArray = (parts * squares) @ parts.T
    size = float(np.trace(shape))
    return shape * (float(np.trace(block)) / size) if size > 0 else block


def _rounded(
    series: Sequence[Series], fit: HarmonicFit, level: FloatArray, lattices: Sequence[float]
) -> list[tuple[int, FloatArray]]:
    """Return the channels whose rounding no noise makes white, and the covariance that it makes."""
    coarse: list[tuple[int, float, float]] = []
    for k, step in enumerate(lattices):
        noise = steady_noise(step, float(fit.rss[k] / fit.count[k]), float(level[k]))
        if noise is not None:
            coarse.append((k, step, noise))

    def rounded(item: tuple[int, float, float]) -> tuple[int, FloatArray]:
        k, step, noise = item
        return k, rounding_covariance(series[k], fit, k, step, noise)

    return in_threads(rounded, coarse, sum(DRAWS * series[k].count for k, *_ in coarse))


def _common_bins(
    groups: Sequence[Sequence[int]],
    spectra: Sequence[_Demodulated],
    span: float,
    spread: FloatArray,
    rounding: FloatArray,
) -> ResidualBins:
    """The bins of all groups in the order of the channels; a pair that a fit took is left out."""
    kept = np.min([spectrum.kept / spectrum.count for spectrum in spectra], axis=0)
    pairs = np.minimum(kept[::2], kept[1::2])
    usable = np.repeat(pairs > min(KEPT_POWER, 0.999 * float(pairs.max())), 2)
    values = np.zeros((spread.size, np.count_nonzero(usable)), dtype=np.complex128)
    for members, spectrum in zip(groups, spectra, strict=True):
        values[members] = spectrum.transform[:, usable] / np.sqrt(spectrum.kept[usable])
    offset: FloatArray = np.repeat(np.arange(1.0, pairs.size + 1), 2) * (2 * np.pi / span)
    offset[1::2] *= -1
    return ResidualBins(values, offset[usable], spread, rounding)


def omega_variance(fit: HarmonicFit, noise: FundamentalNoise) -> tuple[float, float]:
    """Return the variance of the shared frequency, from each channel's own noise.

    With information i, weight w and noise level s of each channel it is sum(w^2 i s) over
    sum(w i)^2; for white noise, where w s = 1, that is the inverse of the summed Fisher
    information (the multi-channel form of Rife & Boorstyn, IEEE Trans. Inf. Theory 20, 1974).

    Args:
        fit: Fit with a shared frequency.

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
        fit: The fit that holds them.
        members: Their indices in the fit.

    Yields:
        Chunk by chunk.
    """
    t_s = group[0].t_s
    scale = time_scale(t_s)
    theta = fit.parameters(members, scale)
    first = fit.model.first
    wider = replace(fit.model, harmonics=fit.model.harmonics + 1)
    for part in chunks(t_s.size):
        rows = basis(t_s[part], fit.omega, wider, scale)
        residual = np.stack([channel.values[part] for channel in group])
        residual -= theta @ rows[: fit.model.size]
        yield Residual(part, rows, rows[first : first + 2, None] * residual)


@dataclass(frozen=True)
class _Demodulated:
    """Residuals of a group of k channels in L bins, in pairs +nu, -nu."""

    transform: ComplexArray  # (k, L)
    kept: FloatArray  # what the fit left of a unit there, (L,)
    count: int

    def power(self) -> FloatArray:
        return np.abs(self.transform) ** 2

    def usable(self) -> BoolArray:
        usable = self.kept > KEPT_POWER * self.count
        return usable if np.any(usable) else self.kept == self.kept.max()


def _span(series: Series) -> float:
    """Return the length of a record, the last sample's own interval included [s]."""
    return float(series.t_s[-1] - series.t_s[0]) * series.count / (series.count - 1)


def _demodulated(
    group: Sequence[Series], fit: HarmonicFit, members: Sequence[int], span: float
) -> _Demodulated:
    """Return the residuals in the bins of a record of this length."""
    t_s = group[0].t_s
    side = bins_per_side(fit.omega * span / (2 * np.pi))
    transform = np.zeros((len(group), 2 * side), dtype=np.complex128)
    overlap = np.zeros((fit.model.size, 2 * side), dtype=np.complex128)
    # Demodulated, the bins turn a few times over the whole record: long records are summed in
    # blocks of less than a hundredth of a radian first.
    block = max(1, t_s.size // _BLOCKS)
    for residual in residuals(group, fit, members):
        count = residual.part.stop - residual.part.start
        edges: IntArray = np.arange(0, count, block, dtype=np.int64)
        filled = np.diff(np.concatenate((edges, [count])))
        waves = _waves(np.add.reduceat(t_s[residual.part], edges) / filled, 2 * np.pi / span, side)
        real, imaginary = np.add.reduceat(residual.turned, edges, axis=2)
        transform += (real + 1j * imaginary) @ waves.T
        overlap += _turned_rows(residual.rows, edges, fit.model) @ waves.T
    removed = np.einsum("pl,pq,ql->l", overlap.conj(), fit.inverse_gram[members[0]], overlap).real
    return _Demodulated(transform, t_s.size - removed, t_s.size)


def _turned_rows(rows: FloatArray, edges: IntArray, model: HarmonicModel) -> ComplexArray:
    """Return the sums over blocks of the basis rows times exp(-j omega t), shape (p, blocks).

    Of a harmonic they are those of its neighbours: cos(h x) exp(-j x) is half the sum of
    exp(j (h - 1) x) and exp(-j (h + 1) x), and -sin(h x) exp(-j x) is j / 2 of their difference.
    """
    first, h = model.first, model.harmonics
    sums = np.add.reduceat(rows, edges, axis=1)
    parts = sums[first:].reshape(h + 1, 2, edges.size)
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
