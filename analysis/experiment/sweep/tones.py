"""Least squares at known frequencies: amplitude, phase and noise of every line.

The model of a channel is y(t) = b + Re sum_l a_l exp(j omega_l t) with the omega_l given, fitted on
the channel's own sampling times. The noise of each line is read from the residual's periodogram in
the nearest bins beside it that the fit has left alone, as in :mod:`.analysis.estimators.spectrum`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import DataError

from ...estimators.harmonic_moments import RELATIVE_FLOOR
from ...estimators.series import Series, shared_times
from ...estimators.spectrum import BINS_PER_SIDE, KEPT_POWER

_REACH = 16
"""Bins to either side that are looked at."""


@dataclass(frozen=True)
class ToneFit:
    """K channels at L tones, with S further lines fitted beside them.

    Attributes:
        amplitude: Complex amplitudes of the tones at t = 0, shape (K, L).
        variance: Of their real and of their imaginary parts, shape (K, L).
        dof: Degrees of freedom of the variances, shape (K, L).
        beside: Complex amplitudes of the further lines, shape (K, S).
        beside_variance: By the noise of the nearest tone, shape (K, S).
    """

    amplitude: ComplexArray
    variance: FloatArray
    dof: FloatArray
    beside: ComplexArray
    beside_variance: FloatArray


def fit_tones(series: Sequence[Series], omega: FloatArray, beside: FloatArray) -> ToneFit:
    """Fit all channels at known frequencies.

    Args:
        series: K channels.
        omega: Angular frequencies of the tones [rad/s], shape (L,).
        beside: Of the further lines, none of them a tone [rad/s], shape (S,).

    Returns:
        The fit.

    Raises:
        DataError: If a channel has too few samples, or too short a record to tell the lines apart.
    """
    lines = np.concatenate([omega, beside])
    tones = omega.size
    nearest = np.argmin(np.abs(beside[:, None] - omega[None, :]), axis=1)
    amplitude = np.zeros((len(series), lines.size), dtype=np.complex128)
    variance = np.zeros((len(series), lines.size))
    dof = np.zeros((len(series), tones))
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
                "the tones cannot be told apart at these sampling times; take a longer window"
            ) from error
        theta: FloatArray = values @ rows.T @ inverse
        amplitude[members] = theta[:, 1::2] + 1j * theta[:, 2::2]
        residual = values - theta @ rows
        floor = RELATIVE_FLOOR * values.var(axis=1)
        spread = np.diag(inverse)
        of_part = 0.5 * (spread[1::2] + spread[2::2])
        for tone in range(tones):
            level, bins = _level(t_s, residual, float(omega[tone]), rows, inverse)
            own = [tone, *(tones + np.flatnonzero(nearest == tone)).tolist()]
            noise = np.maximum(level, floor)[:, None] * of_part[None, own]
            variance[np.ix_(members, own)] = noise
            dof[members, tone] = 2.0 * bins
    return ToneFit(
        amplitude[:, :tones], variance[:, :tones], dof, amplitude[:, tones:], variance[:, tones:]
    )


def _rows(t_s: FloatArray, omega: FloatArray) -> FloatArray:
    """1, then cos and -sin of each line; shape (1 + 2 L, n)."""
    phase: FloatArray = omega[:, None] * t_s[None, :]
    rows = np.ones((1 + 2 * omega.size, t_s.size))
    rows[1::2], rows[2::2] = np.cos(phase), -np.sin(phase)
    return rows


def _level(
    t_s: FloatArray, residual: FloatArray, omega: float, rows: FloatArray, inverse: FloatArray
) -> tuple[FloatArray, int]:
    """Variance per sample of white noise with the residual's power beside a tone, and its bins."""
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
            "the record is too short to tell noise from the tones; take a longer window"
        )
    return np.mean(power, axis=0), len(power)
