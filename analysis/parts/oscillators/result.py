"""Couplings of the controller's oscillators, as recorded."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.estimate import Estimate


@dataclass(frozen=True)
class OscillatorLink:
    """What one oscillator does to another.

    Attributes:
        K: Strength of the coupling [1/s], 0 or more.
        lag_rad: psi, the lead of the source over the target at which it does nothing [rad].
    """

    source: str
    target: str
    K: Estimate
    lag_rad: Estimate


@dataclass(frozen=True)
class Rate:
    """What one oscillator does by itself.

    Attributes:
        omega: Its own rate [rad/s].
        feedback: eps_i, what it takes from its own servo's angle [1/s]; empty where no angle was
            logged.
        noise: Of its phase [rad/sqrt(s)].
    """

    name: str
    omega: Estimate
    feedback: Estimate
    noise: float


@dataclass(frozen=True)
class ChainCoupling:
    """The couplings of one chain of oscillators, or why they are not identifiable.

    Attributes:
        identifiable: Whether the phases determine the couplings.
        why: Why not, or how.
        record: What to record so that they do; None if they do.
        condition_number: Of the regression of the worst oscillator; None where it is infinite.
        kicks: Instants at which a phase jumps.
        reach: abs(i - j) up to which couplings are looked for.
        links: Empty if not identifiable.
        oscillators: Empty if not identifiable.
    """

    plane: str
    identifiable: bool
    why: str
    record: str | None
    condition_number: float | None
    kicks: int
    duration_s: float
    reach: int
    links: tuple[OscillatorLink, ...] = ()
    oscillators: tuple[Rate, ...] = ()
