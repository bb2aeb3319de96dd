"""Least squares at known frequencies: amplitude, phase and noise of every line.

The model of a channel is y(t) = b + Re sum_l a_l exp(j omega_l t) with the omega_l given, fitted on
the channel's own sampling times. The noise of each line is read from the residual's periodogram in
the nearest bins beside it that the fit has left alone, as in :mod:`.analysis.estimators.spectrum`.

Which tones a command is made of: peel the highest line off, refine all, and again.

For commands, which are exact up to the steps of their encoding: what a few lines don't explain is
no multisine.

What a sweep shows of nonlinearity: energy where nothing is commanded.

A linear chain answers at the commanded frequencies only. What stands at the free lines between and
beside the tones is noise or a nonlinearity; and what a nonlinearity puts on the free lines near a
tone, it puts on the tone, too (Pintelon & Schoukens, System Identification, 2nd ed. 2012, ch. 4:
detection lines of a multisine).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import DataError

from ..common.estimate import Estimate
from ..estimators.harmonic import RELATIVE_FLOOR
from ..estimators.intervals import DRAWS, norm_ratio
from ..estimators.series import Series, shared_times
from ..estimators.spectrum import BINS_PER_SIDE, KEPT_POWER
from ..response.rhythm import NYQUIST_SHARE
from .local_coupling import squared

_NEAREST = 6

MOST_TONES = 12
EXPLAINED = 0.98
"""Share of the variance that the tones must explain."""

FAINT = 0.005
"""A line below this share of the strongest is no tone."""

MOST_MULTIPLE = 24
"""Largest multiple of the tones' common step that the lowest of them may be."""

MULTIPLE = 1e-3
"""How near to a whole number a ratio of frequencies must be to count as one."""

_SCOUTS = 4
_MOST_SAMPLES = 8192
_MOST_GAPS = 8  # of an even grid over the samples, as a multiple of these: no clock that jumped
_STEPS = 4

_REACH = 16
"""Bins to either side that are looked at."""


@dataclass(frozen=True)
class Phasors:
    """Complex amplitudes of m joints in r runs.

    Attributes:
        value: Shape (m, r).
        variance: Of their real and of their imaginary parts, shape (m, r).
        dof: Degrees of freedom of the variances, shape (m, r).
    """

    value: ComplexArray
    variance: FloatArray
    dof: FloatArray

    def draws(self, seed: int) -> ComplexArray:
        """Draw errors.

        Returns:
            Student draws, shape (DRAWS, m, r).
        """
        random = np.random.default_rng(seed)
        dof = np.broadcast_to(self.dof, (DRAWS, *self.dof.shape))
        real, imag = random.standard_t(dof), random.standard_t(dof)
        return (np.sqrt(self.variance) * (real + 1j * imag)).astype(np.complex128)


@dataclass(frozen=True)
class Beside:
    """S free lines of m joints in r runs.

    Attributes:
        omega: Angular frequencies [rad/s], shape (S,).
        lines: Amplitudes, one entry a line, each of shape (m, r).
    """

    omega: FloatArray
    lines: tuple[Phasors, ...]


def sideband_energy(tones: tuple[Phasors, ...], beside: Beside) -> Estimate:
    """Return the energy at the free lines over that at the tones.

    Returns:
        The ratio, noise taken off, with an interval of at least 95 %.
    """
    above, below = _joined(beside.lines), _joined(tones)
    return squared(norm_ratio(above.value, above.draws(31), below.value, below.draws(32)))


def distortion(omega: float, tone: Phasors, beside: Beside) -> float:
    """Return how much of a tone a nonlinearity may have made.

    Args:
        omega: Of the tone [rad/s].
        beside: Those of the free lines.

    Returns:
        Root mean square of a free line, of the nearest ones, over that of the tone; noise taken
        off.
    """
    nearest: list[int] = np.argsort(np.abs(beside.omega - omega))[:_NEAREST].tolist()
    near = _joined(tuple(beside.lines[k] for k in nearest))
    energy = float(np.sum(np.abs(near.value) ** 2 - 2 * near.variance)) / len(nearest)
    return float(np.sqrt(max(0.0, energy)) / np.linalg.norm(tone.value))


def _joined(parts: tuple[Phasors, ...]) -> Phasors:
    columns = zip(*((part.value, part.variance, part.dof) for part in parts), strict=True)
    return Phasors(*(np.concatenate(column, axis=1) for column in columns))


def find_tones(commands: Sequence[Series]) -> FloatArray | None:
    """Find the frequencies of a multisine.

    Args:
        commands: By joint; those that never move are ignored.

    Returns:
        Angular frequencies, rising [rad/s], at least two of them; None where the commands are no
        sum of a few tones, or all tones are harmonics of the lowest: that is a gait.
    """
    moving = [command for command in commands if command.count > 64 and np.ptp(command.values) > 0]
    moving.sort(key=lambda command: float(np.var(command.values)), reverse=True)
    scouts = [_cut(command) for command in moving[:_SCOUTS]]
    if not scouts:
        return None
    total = sum(float(np.sum(scout.values**2)) for scout in scouts)
    omega: FloatArray = np.zeros(0)
    residual: list[FloatArray] = [scout.values for scout in scouts]
    for _ in range(MOST_TONES):
        peak = _peak(scouts, residual)
        if peak is None or np.any(np.abs(omega - peak) < 2 * np.pi / _span(scouts)):
            break
        grown: FloatArray = np.concatenate([omega, [peak]])
        for _ in range(_STEPS):
            grown = grown + _refine(scouts, grown)[0]
        _, amplitude, left = _refine(scouts, grown)
        if amplitude[:, -1].max() < FAINT * amplitude.max():
            break
        omega, residual = grown, left
    omega = np.sort(omega)
    explained = 1 - sum(float(np.sum(values**2)) for values in residual) / total
    if omega.size < 2 or explained < EXPLAINED:
        return None
    multiples: FloatArray = omega / omega[0]
    return None if np.all(np.abs(multiples - np.round(multiples)) < MULTIPLE) else omega


def common_step(omega: FloatArray) -> float | None:
    """Find the largest frequency of which all tones are multiples.

    Args:
        omega: Rising [rad/s].

    Returns:
        It [rad/s], or None where there is none.
    """
    for multiple in range(1, MOST_MULTIPLE + 1):
        place: FloatArray = omega * multiple / omega[0]
        if np.all(np.abs(place - np.round(place)) < MULTIPLE * multiple):
            return float(np.mean(omega / np.round(place)))
    return None


def _cut(series: Series) -> Series:
    values = series.values[:_MOST_SAMPLES]
    return Series(series.name, series.t_s[:_MOST_SAMPLES], values - values.mean())


def _span(scouts: Sequence[Series]) -> float:
    return max(float(scout.t_s[-1] - scout.t_s[0]) for scout in scouts)


def _peak(scouts: Sequence[Series], residual: Sequence[FloatArray]) -> float | None:
    """Return the highest line of the residual [rad/s]; on an even grid, as a starting point."""
    period = max(scout.period_s for scout in scouts)
    start = max(float(scout.t_s[0]) for scout in scouts)
    stop = min(float(scout.t_s[-1]) for scout in scouts)
    count = int((stop - start) / period) + 1 if stop > start else 0
    if not 64 <= count <= _MOST_GAPS * _MOST_SAMPLES:
        return None
    grid = start + period * np.arange(count)
    length = 1 << int(np.ceil(np.log2(4 * count)))
    power = np.zeros(length // 2 + 1)
    for scout, left in zip(scouts, residual, strict=True):
        even = np.interp(grid, scout.t_s, left) * np.hanning(count)
        power += np.abs(np.fft.rfft(even, length)) ** 2
    frequency = np.fft.rfftfreq(length, period)
    inside = (frequency > 1.5 / (stop - start)) & (frequency < NYQUIST_SHARE / period)
    if not inside.any():
        return None
    return float(2 * np.pi * frequency[inside][np.argmax(power[inside])])


def _refine(
    scouts: Sequence[Series], omega: FloatArray
) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    """Return a Gauss-Newton step of all frequencies, the amplitudes and residuals before it.

    Variable projection: the part of the slopes dy/domega that no other parameter explains.
    """
    tones = omega.size
    normal, right = np.zeros((tones, tones)), np.zeros(tones)
    sizes: list[FloatArray] = []
    left: list[FloatArray] = []
    for scout in scouts:
        phase: FloatArray = omega[:, None] * scout.t_s[None, :]
        cos, sin = np.cos(phase), np.sin(phase)
        rows: FloatArray = np.concatenate([np.ones((1, scout.count)), cos, -sin])
        inverse: FloatArray = np.linalg.inv(rows @ rows.T).astype(np.float64)
        theta: FloatArray = inverse @ (rows @ scout.values)
        re, im = theta[1 : 1 + tones, None], theta[1 + tones :, None]
        rest: FloatArray = scout.values - theta @ rows
        slope: FloatArray = -scout.t_s * (re * sin + im * cos)
        slope = slope - (slope @ rows.T) @ inverse @ rows
        normal += slope @ slope.T
        right += slope @ rest
        sizes.append(np.hypot(re, im)[:, 0])
        left.append(rest)
    limit = np.pi / (2 * _span(scouts))
    step: FloatArray = np.linalg.lstsq(normal, right, rcond=None)[0].astype(np.float64)
    return np.clip(step, -limit, limit), np.stack(sizes), left


@dataclass(frozen=True)
class ToneFit:
    """K channels at L tones, then at S further lines that were fitted beside them.

    Attributes:
        amplitude: Complex amplitudes at t = 0, shape (K, L + S).
        variance: Of their real and of their imaginary parts, of a further line by the noise of
            the nearest tone, shape (K, L + S).
        dof: Degrees of freedom of the variances, of further lines the least of the tones', shape
            (K, L + S).
    """

    amplitude: ComplexArray
    variance: FloatArray
    dof: FloatArray


def fit_tones(series: Sequence[Series], omega: FloatArray, beside: FloatArray) -> ToneFit:
    """Fit all channels at known frequencies.

    Args:
        series: K channels.
        omega: Angular frequencies of the tones [rad/s], shape (L,).
        beside: Of the further lines, none of them a tone [rad/s], shape (S,).

    Raises:
        DataError: If a channel has too few samples, or too short a record to resolve the lines.
    """
    lines = np.concatenate([omega, beside])
    tones = omega.size
    nearest = np.argmin(np.abs(beside[:, None] - omega[None, :]), axis=1)
    amplitude = np.zeros((len(series), lines.size), dtype=np.complex128)
    variance = np.zeros((len(series), lines.size))
    dof = np.zeros((len(series), lines.size))
    for members in shared_times(series):
        t_s = series[members[0]].t_s
        if t_s.size <= 2 * lines.size + 2:
            raise DataError(
                f"{series[members[0]].name}: {t_s.size} samples are too few for {lines.size} "
                "frequencies; take a longer window"
            )
        values = np.stack([series[k].values for k in members])
        rows = _rows(t_s, lines)
        try:
            inverse: FloatArray = np.linalg.inv(rows @ rows.T).astype(np.float64)
        except np.linalg.LinAlgError as error:
            raise DataError(
                "the tones cannot be separated at these sampling times; take a longer window"
            ) from error
        theta: FloatArray = values @ rows.T @ inverse
        amplitude[members] = theta[:, 1::2] + 1j * theta[:, 2::2]
        residual = values - theta @ rows
        floor = RELATIVE_FLOOR * values.var(axis=1)
        spread = np.diag(inverse)
        of_part = 0.5 * (spread[1::2] + spread[2::2])
        for tone in range(tones):
            level, bins = _level(t_s, residual, float(omega[tone]), rows, inverse)
            columns = [tone, *(tones + np.flatnonzero(nearest == tone)).tolist()]
            variance[np.ix_(members, columns)] = (
                np.maximum(level, floor)[:, None] * of_part[None, columns]
            )
            dof[members, tone] = 2.0 * bins
    dof[:, tones:] = dof[:, :tones].min(axis=1, keepdims=True)
    return ToneFit(amplitude, variance, dof)


def _rows(t_s: FloatArray, omega: FloatArray) -> FloatArray:
    """Return 1, then cos and -sin of each line; shape (1 + 2 L, n)."""
    phase: FloatArray = omega[:, None] * t_s[None, :]
    rows = np.ones((1 + 2 * omega.size, t_s.size))
    rows[1::2], rows[2::2] = np.cos(phase), -np.sin(phase)
    return rows


def _level(
    t_s: FloatArray, residual: FloatArray, omega: float, rows: FloatArray, inverse: FloatArray
) -> tuple[FloatArray, int]:
    """Return the noise variance per sample beside a tone, and the number of bins."""
    span = float(t_s[-1] - t_s[0]) * t_s.size / max(t_s.size - 1, 1)
    power: list[FloatArray] = []
    for side in (1, -1):
        # Below half a bin a wave and its mirror image at negative frequency are one.
        reach = _REACH if side > 0 else min(_REACH, int(omega * span / (2 * np.pi) - 0.5))
        phase: FloatArray = t_s[:, None] * (
            omega + 2 * np.pi * side / span * np.arange(1, reach + 1)
        )
        cos, sin = np.cos(phase), np.sin(phase)
        over_cos, over_sin = rows @ cos, rows @ sin
        kept = t_s.size - np.einsum("pl,pq,ql->l", over_cos, inverse, over_cos)
        kept -= np.einsum("pl,pq,ql->l", over_sin, inverse, over_sin)
        chosen = np.flatnonzero(kept > KEPT_POWER * t_s.size)[:BINS_PER_SIDE]
        squared = (residual @ cos[:, chosen]) ** 2 + (residual @ sin[:, chosen]) ** 2
        power += list((squared / kept[chosen]).T)
    if not power:
        raise DataError(
            "the record is too short to separate noise from the tones; take a longer window"
        )
    return np.mean(power, axis=0), len(power)
