"""Results on oscillators: frozen values, parts of an analysis and of an experiment."""

from __future__ import annotations

from dataclasses import dataclass

from ..common.estimate import Estimate
from .coupling import Rows

ENTRAINMENT_LABEL = (
    "P read as entrainment, P = (Gamma + L)^-1 Gamma: Gamma^-1 L = P^-1 - I, coupling relative to "
    "the entrainment by the command; absolute rates need the way back from kicks"
)


@dataclass(frozen=True)
class Mode:
    """One mode of I - P.

    Attributes:
        real: Rate at which it relaxes; negative = it grows [eps].
        imag: Rate at which it turns meanwhile [eps].
        sensitivity: How much more its rate may move than P: 1 in a normal matrix.
        pattern_abs: Share of each joint, of a vector of length 1, shape (m,).
        pattern_rad: Phase of each joint in it [rad], shape (m,).
    """

    real: Estimate
    imag: Estimate
    sensitivity: float
    pattern_abs: tuple[float, ...]
    pattern_rad: tuple[float, ...]


@dataclass(frozen=True)
class Comparator:
    """A homogeneous chain with the same ||I - P||: Toeplitz, with rows scaled to sum to 1.

    Attributes:
        slowest: Its slowest rate [eps].
        real: Its rates' real parts, the slowest first [eps].
    """

    slowest: float
    strong: int
    real: tuple[float, ...]


@dataclass(frozen=True)
class Levels:
    """Pseudospectrum of I - P: how large an error of P makes z an eigenvalue.

    Attributes:
        real: Of z [eps], shape (r,).
        imag: Of z [eps], shape (c,).
        level: Smallest singular value of z I - (I - P) on deviations from the mean phase,
            shape (r, c).
        noise: Spectral norm that the error of that matrix stays below (95 %).
    """

    real: tuple[float, ...]
    imag: tuple[float, ...]
    level: Rows
    noise: float


@dataclass(frozen=True)
class RelativeCoupling:
    """The entrainment reading.

    Attributes:
        value: P^-1 - I, row = joint that follows; None where P is singular.
        ci95_half: Half widths of the 95 % intervals, one by one.
        condition_number: Of P; None where it is infinite.
    """

    label: str
    value: Rows | None
    ci95_half: Rows | None
    condition_number: float | None


@dataclass(frozen=True)
class BodyOscillators:
    """How oscillators with feedback from their servos would synchronise through the body.

    Attributes:
        joints: Names, head to tail, m.
        slowest: Real part of the slowest rate but that of all phases together [eps].
        strong: Modes with a rate above 0.1.
        strong_above: That bound [eps].
        growth: Fastest growth of a deviation for a while [eps]; negative = all shrink at once.
        modes: The slowest first, m - 1.
        comparator: A homogeneous chain as strong.
        explicit_coupling: Coupling of next neighbours, both ways, which lifts every mode to
            ``strong_above`` [eps]; its value is None where none does.
        entrainment: The other reading of P.
    """

    answer: str
    joints: tuple[str, ...]
    slowest: Estimate
    strong: Estimate
    strong_above: float
    growth: Estimate
    modes: tuple[Mode, ...]
    comparator: Comparator
    explicit_coupling: Estimate
    pseudospectrum: Levels
    entrainment: RelativeCoupling


@dataclass(frozen=True)
class LoopMode:
    """One pattern of the phases of a closed loop.

    Attributes:
        rate: At which it relaxes [1/s]; negative = it grows.
        turning: At which it turns meanwhile [rad/s].
        pattern_abs: Share of each joint, of a vector of length 1, shape (m,).
        pattern_rad: Phase of each joint in it [rad], shape (m,).
    """

    rate: Estimate
    turning: Estimate
    pattern_abs: tuple[float, ...]
    pattern_rad: tuple[float, ...]


@dataclass(frozen=True)
class Relaxation:
    """What is left of a kick, at k times.

    Attributes:
        times_s: After the kick [s], k.
        phase_rad: Deviations [rad], shape (k, m).
        low_rad: Low ends of their 95 % intervals [rad], shape (k, m).
        high_rad: High ends [rad], shape (k, m).
    """

    times_s: tuple[float, ...]
    phase_rad: Rows
    low_rad: Rows
    high_rad: Rows


@dataclass(frozen=True)
class ClosedLoop:
    """Relaxation of oscillators with feedback, d phi' = J d phi, predicted from kicks.

    Attributes:
        joints: Names, head to tail, m.
        eps: Of the feedback [1/s].
        age_s: How old an angle is on average when it is used [s].
        frequency_hz: Of the gait that was kicked.
        bias: b = g sin Delta, which takes the steady part of the feedback away, m.
        J: Rates [1/s], row = oscillator that is turned, shape (m, m).
        J_standard_error: Same shape.
        modes: The slowest first, m - 1; all phases together neither relax nor grow.
        relaxation: What is left of a kick, if one was asked for.
        valid_to: Largest deviation that held-out runs support [rad]; None where there are none.
        fastest: Largest rate of a deviation [1/s].
        limits: What the prediction holds for, what speaks against it first.
    """

    answer: str
    joints: tuple[str, ...]
    eps: float
    age_s: float
    frequency_hz: float
    bias: tuple[float, ...]
    J: Rows
    J_standard_error: Rows
    modes: tuple[LoopMode, ...]
    relaxation: Relaxation | None
    valid_to: float | None
    fastest: float
    limits: tuple[str, ...]
