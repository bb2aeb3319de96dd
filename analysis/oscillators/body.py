"""From P of a kick experiment to what oscillators would do on this body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtridf

from undulog.capture.common.arrays import FloatArray

from ..estimators.intervals import CONFIDENCE, noise_draws
from ..results import formats
from ..results.coupling import LocalCoupling, Matrix, rows_of
from ..results.estimate import Estimate
from ..results.oscillators import (
    ENTRAINMENT_LABEL,
    BodyOscillators,
    Comparator,
    Levels,
    Mode,
    RelativeCoupling,
)
from .laplacian import STRONG, Spectrum, SpectrumIntervals, intervals, pseudospectrum, spectrum
from .predictions import entrainment, explicit_coupling, homogeneous

EXPLICIT_DRAWS = 100
"""Draws of P for the interval of the explicit coupling, each a root to find."""

_MOST_DOF = 1e6
"""Student's t is a normal distribution by then."""


@dataclass(frozen=True)
class MeasuredP:
    """P with its errors, each of shape (m, m); the correlation of a column's, or None."""

    value: FloatArray
    error: FloatArray
    dof: FloatArray
    correlation: FloatArray | None = None


def body_oscillators(coupling: LocalCoupling) -> BodyOscillators:
    """What oscillators that feel their servos would do.

    Args:
        coupling: From kicks around one gait.

    Returns:
        Modes, comparator, and what explicit coupling must add.
    """
    P = measured(coupling.P, phase_correlation(coupling))
    found, said = spectrum(P.value), intervals(P)
    like = spectrum(homogeneous(P.value))
    levels = pseudospectrum(P)
    explicit = _explicit(P)
    return BodyOscillators(
        answer=_answer(found, said, like, explicit),
        joints=coupling.joints,
        slowest=said.gap,
        strong=said.strong,
        strong_above=STRONG,
        growth=said.growth,
        modes=_modes(found, said),
        comparator=Comparator(like.gap, like.strong, tuple(like.rates.real.tolist())),
        explicit_coupling=explicit,
        pseudospectrum=Levels(
            tuple(levels.real.tolist()),
            tuple(levels.imag.tolist()),
            rows_of(levels.level),
            levels.noise,
        ),
        entrainment=_relative(P),
    )


def phase_correlation(coupling: LocalCoupling) -> FloatArray | None:
    """Correlation of the joints' phases in a run's errors, shape (m, m); None if unknown."""
    if coupling.scatter is None:
        return None
    m = len(coupling.joints)
    return np.array(coupling.scatter.correlation)[:m, :m]


def measured(matrix: Matrix, correlation: FloatArray | None = None) -> MeasuredP:
    """A matrix of a result with its errors.

    Args:
        matrix: Of a coupling.
        correlation: Of a column's errors, shape (m, m), or None.

    Returns:
        Value, errors, and the degrees of freedom that the intervals' factor says.
    """
    value, error, half = (
        np.array(one) for one in (matrix.value, matrix.standard_error, matrix.ci95_half)
    )
    # The degrees of freedom from the factor between the two.
    factor = np.divide(half, error, out=np.full(half.shape, np.nan), where=error > 0)
    dof = np.asarray(stdtridf(0.5 + CONFIDENCE / 2, factor), dtype=np.float64)
    usable = np.where(np.isfinite(dof) & (dof > 0), dof, _MOST_DOF)
    return MeasuredP(value, error, np.minimum(usable, _MOST_DOF), correlation)


def _modes(found: Spectrum, said: SpectrumIntervals) -> tuple[Mode, ...]:
    return tuple(
        Mode(
            real=Estimate(float(rate.real), _pair(said.real[k])),
            imag=Estimate(float(rate.imag), _pair(said.imag[k])),
            sensitivity=float(found.sensitivity[k]),
            pattern_abs=tuple(np.abs(found.patterns[:, k]).tolist()),
            pattern_rad=tuple(np.angle(found.patterns[:, k]).tolist()),
        )
        for k, rate in enumerate(found.rates.tolist())
    )


def _explicit(P: MeasuredP) -> Estimate:
    value = explicit_coupling(P.value)
    if value is None:
        return Estimate()
    draws = [explicit_coupling(P.value + one) for one in noise_draws(P, 41)[:EXPLICIT_DRAWS]]
    if None in draws:
        return Estimate(value)
    tail = (1.0 - CONFIDENCE) / 2
    low, high = np.quantile(np.array(draws, dtype=np.float64), (tail, 1.0 - tail))
    return Estimate(value, (min(value, float(low)), max(value, float(high))))


def _relative(P: MeasuredP) -> RelativeCoupling:
    reading = entrainment(P)
    condition = reading.condition_number
    return RelativeCoupling(
        ENTRAINMENT_LABEL,
        None if reading.relative is None else rows_of(reading.relative),
        None if reading.half is None else rows_of(reading.half),
        condition if np.isfinite(condition) else None,
    )


def _answer(found: Spectrum, said: SpectrumIntervals, like: Spectrum, explicit: Estimate) -> str:
    count = len(found.rates)
    told = (
        f"through the body alone the slowest of {count} patterns {_pace(said.gap)} and "
        f"{found.strong} relax at more than {STRONG:g} eps (a homogeneous chain as "
        f"strong: {formats.number(like.gap, 3)} eps, {like.strong})"
    )
    if explicit.value is None:
        return f"{told}; no coupling of next neighbours lifts all of them to {STRONG:g} eps"
    if explicit.value == 0.0:
        return f"{told}; that is enough without explicit coupling"
    return (
        f"{told}; explicit coupling must supply the gap: "
        f"{formats.estimate(explicit, ' eps', most=3)} between next neighbours lifts all to "
        f"{STRONG:g} eps"
    )


def _pace(gap: Estimate) -> str:
    """What a pattern does: a negative rate of relaxing is one of growth."""
    if gap.value is None or gap.value >= 0.0:
        return f"relaxes at {formats.estimate(gap, ' eps', most=4)}"
    ends = None if gap.ci95 is None else (-gap.ci95[1], -gap.ci95[0])
    return f"grows at {formats.estimate(Estimate(-gap.value, ends), ' eps', most=4)}"


def _pair(ends: FloatArray) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])
