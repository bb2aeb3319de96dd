r"""How far levels of distortion are off their expectation, from a few random-phase realisations.

A static nonlinearity of order 3 puts into each line the products of three others,

.. math:: S_k / U_k \propto \sum_{k_1 + k_2 = k_3 + k} e^{i (\phi_1 + \phi_2 - \phi_3 - \phi_k)}

and the same four lines make the same product in each of them: the distortion of many lines varies
together from realisation to realisation, and neither the scatter of a few realisations nor that of
the lines shows how much. It is simulated instead, with the lines and amplitudes of the experiment:
order 3 for the excited lines and the odd ones left out, order 2 for the even ones. A nonlinearity
with memory turns the products by different phases, so that lines vary together less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray

from ..estimators.intervals import CONFIDENCE

REALISATIONS = 400
"""That are simulated: quantiles then are known to a tenth of the width."""

DRAWS = 1000
"""Of as many realisations as the experiment has, from those."""

ROUNDING = float(np.finfo(np.float64).eps)
"""Share of the response's power below which its scatter is rounding."""


@dataclass(frozen=True)
class LevelSpread:
    """Ends of the central 95 % of a level's square over its expectation; 1 is no spread.

    Attributes:
        low: At most 1.
        high: At least 1.
    """

    low: float = 1.0
    high: float = 1.0


@dataclass(frozen=True)
class DistortionSpread:
    """Of the distortion at the excited lines, and at odd and even lines that are left out."""

    excited: LevelSpread = LevelSpread()
    odd: LevelSpread = LevelSpread()
    even: LevelSpread = LevelSpread()


def distortion_spread(
    lines: IntArray, amplitudes: FloatArray, realisations: int
) -> DistortionSpread:
    """Simulate how far levels of distortion are off.

    Args:
        lines: Excited multiples of the fundamental, ascending, shape (n,).
        amplitudes: Of the command at these, in any unit, shape (n,).
        realisations: That the experiment has.
    """
    rng = np.random.default_rng(0)
    last = int(lines[-1])
    samples = 1 << (4 * last).bit_length()  # products of three lines don't fold onto the lines
    phases = rng.uniform(0, 2 * np.pi, (REALISATIONS, lines.size))
    inputs = np.zeros((REALISATIONS, samples // 2 + 1), np.complex128)
    inputs[:, lines] = amplitudes * np.exp(1j * phases)
    command = np.fft.irfft(inputs, samples, axis=1)
    third, second = (np.fft.rfft(command**order, axis=1) for order in (3, 2))
    chosen = rng.integers(REALISATIONS, size=(DRAWS, realisations))
    free = np.setdiff1d(np.arange(int(lines[0]), last), lines)
    return DistortionSpread(
        _of_responses(third[:, lines] / inputs[:, lines], chosen),
        _of_powers(third[:, free[free % 2 == 1]], chosen),
        _of_powers(second[:, free[free % 2 == 0]], chosen),
    )


def _of_responses(responses: ComplexArray, chosen: IntArray) -> LevelSpread:
    """Return the spread of the scatter of responses about their mean; of one there is none."""
    if chosen.shape[1] < 2:
        return LevelSpread()
    off = responses - responses.mean(axis=0)
    gram = np.real(off @ off.conj().T)
    squares = np.diag(gram)
    count = chosen.shape[1]
    total = squares[chosen].sum(axis=1)
    across = gram[chosen[:, :, None], chosen[:, None, :]].sum(axis=(1, 2)) / count
    expected = float(squares.mean())
    if expected <= ROUNDING * float(np.mean(np.abs(responses) ** 2)):
        return LevelSpread()
    return _quantiles((total - across) / (count - 1), expected)


def _of_powers(spectra: ComplexArray, chosen: IntArray) -> LevelSpread:
    if not spectra.shape[1]:
        return LevelSpread()
    power = np.sum(np.abs(spectra) ** 2, axis=1)
    return _quantiles(power[chosen].mean(axis=1), float(power.mean()))


def _quantiles(draws: FloatArray, expected: float) -> LevelSpread:
    ends = [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]
    if not expected > 0:
        return LevelSpread()
    low, high = (np.quantile(draws, ends) / expected).tolist()
    return LevelSpread(min(low, 1.0), max(high, 1.0))
