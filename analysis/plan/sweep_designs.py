"""Runs that make the coupling of a chain without contact identifiable: lag sweep and multisine.

Without contact, at small amplitude, a = H c at every frequency. From r runs, Y = H C; H = Y C^-1 is
best told when C is a DFT matrix, C_jk = A exp(j 2 pi j k / m): its condition number is 1. A lag
sweep is just that: m gaits of the lags 2 pi k / m. In a multisine every frequency has such a matrix
of its own, all in the same m runs (Dobrowiecki, Schoukens & Guillaume, "Optimized excitation
signals for MIMO frequency response function measurements", IEEE Trans. Instrum. Meas. 55, 2006).
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from .designs import PlannedRun, Tone


def lag_sweep(m: int, amplitude: float, repeats: int = 1, seed: int = 1) -> tuple[PlannedRun, ...]:
    """As many gaits as there are joints, of the lags 2 pi k / m.

    Args:
        m: Driven joints.
        amplitude: Of every command [rad].
        repeats: How often all of it is run.
        seed: Of the order, random so that warming up looks like no lag.

    Returns:
        m runs a repeat.
    """
    random = np.random.default_rng(seed)
    runs: list[PlannedRun] = []
    for _ in range(repeats):
        for k in random.permutation(m).tolist():
            facts = {"kind": "lag", "lag_rad": f"{2 * np.pi * k / m:.6f}"}
            runs.append(PlannedRun(f"lag{k:02d}", amplitude * _dft(m)[k], facts))
    return tuple(runs)


def multisine(
    m: int, amplitude: float, omega: FloatArray, repeats: int = 1, seed: int = 1
) -> tuple[PlannedRun, ...]:
    """All joints at all tones in each of m runs, with the phases of a DFT matrix over the runs.

    Args:
        m: Driven joints.
        amplitude: Of the first tone of every command [rad]; the others fall as 1 / omega^2, so
            that all of them need about the same torque, and none shakes the chain out of its
            linear range.
        omega: Angular frequencies of the tones, the gait's first [rad/s], shape (L,).
        repeats: How often all of it is run.
        seed: Of the tones' own phases and of the order.

    Returns:
        m runs a repeat.
    """
    random = np.random.default_rng(seed)
    phase = np.exp(1j * random.uniform(-np.pi, np.pi, omega.size))
    strength = phase * (omega[0] / omega) ** 2
    runs: list[PlannedRun] = []
    for _ in range(repeats):
        for k in random.permutation(m).tolist():
            each = [(amplitude * one * _dft(m)[k]).astype(np.complex128) for one in strength]
            more = tuple(Tone(float(w), a) for w, a in zip(omega[1:], each[1:], strict=True))
            facts = {"kind": "multisine", "experiment": str(k)}
            runs.append(PlannedRun(f"experiment{k:02d}", each[0], facts, more))
    return tuple(runs)


def tones(omega: float, count: int) -> FloatArray:
    """Frequencies such that none is another plus a whole number of the gait's.

    In units of the gait's frequency over 2 L - 1, tone i is the line i (2 L - 1) + i: remainders
    0 .. L - 1 are all different, of either sign. So the sidebands that a nonlinearity makes of one
    tone around the gait's multiples fall on no other tone.

    Args:
        omega: Of the gait, itself the first tone [rad/s].
        count: L, at least 1.

    Returns:
        Rising [rad/s], shape (L,).
    """
    step = 2 * count - 1
    place = np.arange(count)
    return omega * ((place + 1) * step + place) / step


def period_s(omega: float, count: int) -> float:
    """The time after which a multisine repeats [s].

    Args:
        omega: Of the gait [rad/s].
        count: Tones.

    Returns:
        2 L - 1 periods of the gait.
    """
    return (2 * count - 1) * 2 * np.pi / omega


def _dft(m: int) -> ComplexArray:
    """exp(j 2 pi j k / m), row k = run, column j = joint; shape (m, m)."""
    place = np.arange(m)
    return np.exp(2j * np.pi / m * place[:, None] * place[None, :]).astype(np.complex128)
