"""Odd random-phase multisines: from a band and a period to the commands of an experiment.

A realisation is the sum of sines of equal amplitude and random phase at odd multiples (lines) of
the reciprocal period. In each group of :data:`GROUP` consecutive odd lines one, drawn at random, is
left out, and all even lines are: a nonlinearity of odd order responds at those odd lines, one of
even order at the even ones (detection lines). All realisations excite the same lines with the same
power, so that all of them have the same best linear approximation; their phases differ. Of
:data:`DRAWS` draws of the phases the one with the least peak is taken.

With m joints and ``orthogonal`` inputs a realisation takes m runs: each joint has phases of its
own, which a DFT matrix over the runs multiplies, so that the commands are a regular matrix at every
line and the response of every joint to every command is identifiable.

Source: Pintelon & Schoukens, System Identification, 2nd ed. (Wiley 2012), sections 2.7 and 4.3;
Dobrowiecki, Schoukens & Guillaume, IEEE Trans. Instrum. Meas. 55 (2006) 1774-1780.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import UsageError

from ..experiment.multisine_runs import KIND, MOST_LINES, Inputs
from .designs import RATE_HZ, PlannedRun, Tone, dft

GROUP = 4
"""Consecutive odd lines of which one is left out."""

DRAWS = 64
"""Draws of the phases of which the one with the least peak is taken."""

LEAST_LINES = 6
HIGHEST_HZ = RATE_HZ / 8
"""Highest excited frequency [Hz]: above it the samples of the plan hardly follow a sine."""


@dataclass(frozen=True)
class Multisine:
    """What the realisations of one experiment share.

    Attributes:
        lines: Excited multiples of 1 / ``period_s``, odd, ascending, shape (k,).
        period_s: After which the commands repeat [s].
        amplitude: Of each excited line's sine [rad].
        peak: Largest deviation from the offset in any run [rad].
    """

    lines: IntArray
    period_s: float
    amplitude: float
    peak: float

    @property
    def rms(self) -> float:
        """Root mean square of each command about its offset [rad]."""
        return self.amplitude * float(np.sqrt(self.lines.size / 2))


def odd_lines(band_hz: tuple[float, float], period_s: float, seed: int) -> IntArray:
    """Draw the excited lines.

    Args:
        band_hz: Lowest and highest frequency [Hz].
        period_s: A whole number of samples of a plan [s].

    Raises:
        UsageError: If the band or the period has no such lines.
    """
    low, high = band_hz
    samples = period_s * RATE_HZ
    if not 0 < low < high <= HIGHEST_HZ:
        raise UsageError(
            f"--band {low:g} {high:g} is not from a lower to a higher frequency above 0 and up to "
            f"{HIGHEST_HZ:g} Hz"
        )
    if not (0 < samples < 1e6 and abs(samples - round(samples)) < 1e-6):
        raise UsageError(f"--period {period_s:g} is not a multiple of {1 / RATE_HZ:g} s")
    first, last = np.ceil(low * period_s - 1e-9), np.floor(high * period_s + 1e-9)
    odd = np.arange(int(first) | 1, int(last) + 1, 2)
    if odd.size - odd.size // GROUP < LEAST_LINES:
        raise UsageError(
            f"--band {low:g} {high:g} holds {odd.size} odd multiples of 1/{period_s:g} Hz, fewer "
            f"than {LEAST_LINES} of them excited; take a longer --period or a wider --band"
        )
    random = np.random.default_rng([seed, 0])
    left_out = np.arange(0, odd.size - GROUP + 1, GROUP)
    left_out = left_out + random.integers(0, GROUP, left_out.size)
    lines: IntArray = np.delete(odd, left_out).astype(np.int64)
    if lines.size > MOST_LINES:
        raise UsageError(
            f"--band and --period give {lines.size} excited lines, at most {MOST_LINES} are "
            "planned; take a shorter --period or a narrower --band"
        )
    return lines


def random_phase_runs(
    m: int,
    lines: IntArray,
    period_s: float,
    amplitude: float,
    *,
    of_peak: bool,
    realisations: int,
    inputs: Inputs,
    seed: int,
) -> tuple[Multisine, tuple[PlannedRun, ...]]:
    """Plan the runs of all realisations.

    Args:
        m: Driven joints.
        lines: Of :func:`odd_lines`.
        amplitude: Root mean square of each command, or the largest peak of all [rad].
        of_peak: Whether ``amplitude`` is the peak.

    Returns:
        What they share, and the runs: one a realisation, or m with orthogonal inputs.
    """
    random = np.random.default_rng([seed, 1])
    own = m if inputs == "orthogonal" else 1
    drawn = [_phases(own, lines, random, rotated=own > 1) for _ in range(realisations)]
    unit_rms = float(np.sqrt(lines.size / 2))
    highest = max(float(peaks.max()) for _, peaks in drawn)
    size = amplitude / (highest if of_peak else unit_rms)
    shared = Multisine(lines, period_s, size, size * highest)
    omega = 2 * np.pi * lines / period_s
    turns = dft(own)
    runs: list[PlannedRun] = []
    for r, (phasors, peaks) in enumerate(drawn):
        for e in range(own):
            each = np.broadcast_to(size * phasors * turns[e][:, None], (m, lines.size))
            facts = {
                "kind": KIND,
                "realisation": str(r),
                "experiment": str(e),
                "crest_factor": f"{float(peaks.max()) / unit_rms:.4g}",
            }
            label = f"realisation{r:02d}" + (f"-experiment{e:02d}" if own > 1 else "")
            tones = tuple(
                Tone(float(w), np.ascontiguousarray(each[:, k])) for k, w in enumerate(omega)
            )
            runs.append(PlannedRun(label, np.zeros(m, dtype=np.complex128), facts, tones))
    return shared, tuple(runs)


def _phases(
    count: int, lines: IntArray, random: np.random.Generator, *, rotated: bool
) -> tuple[ComplexArray, FloatArray]:
    """Return phasors of modulus 1 of least peak, shape (count, k), and the peaks, shape (count,).

    Args:
        rotated: Whether runs multiply them by a constant phase: the peak is then that of the
            envelope, which holds for all of them.
    """
    length = int(2 ** np.ceil(np.log2(16 * int(lines[-1]))))
    best, peaks = np.zeros((count, lines.size), dtype=np.complex128), np.zeros(count)
    for j in range(count):
        phasors = np.exp(2j * np.pi * random.random((DRAWS, lines.size)))
        spectrum = np.zeros((DRAWS, length), dtype=np.complex128)
        spectrum[:, lines] = phasors * length
        analytic = np.fft.ifft(spectrum)
        peak = np.abs(analytic if rotated else analytic.real).max(axis=1)
        least = int(np.argmin(peak))
        best[j], peaks[j] = phasors[least], peak[least]
    return best, peaks
