"""The body as a whole: motion of its links, shape over a cycle, travel, and ground contact."""

from __future__ import annotations

from dataclasses import dataclass

from ..common.estimate import Estimate
from ..parts.body.result import ShapeMode

EFFECTIVE = (
    "effective: exact to first order where friction is viscous; under Coulomb friction, which is "
    "rate-independent but not linear, it holds around this gait only"
)


@dataclass(frozen=True)
class ConnectionEntry:
    """One entry of A over the phase of the mean gait.

    Attributes:
        velocity: ``forward``, ``left`` [m/rad] or ``turn`` [1] of the virtual chassis.
        mode: Shape mode whose rate it is multiplied with, from 1.
        value: At each phase.
        ci95_half: Half widths of the 95 % intervals.
    """

    velocity: str
    mode: int
    value: tuple[float, ...]
    ci95_half: tuple[float, ...]


@dataclass(frozen=True)
class PredictedTravel:
    """Travel of one session over a cycle, predicted from the other sessions' gaits.

    Attributes:
        forward_m: Predicted displacement along the mean heading of the cycle; empty with ``why``.
        left_m: Predicted displacement across it.
        turn_rad: Predicted change of heading.
        measured_forward_m: The same as measured.
        why: Why nothing is predicted: outside the range of the others; None where it is.
    """

    path: str
    frequency_hz: float
    forward_m: Estimate
    left_m: Estimate
    turn_rad: Estimate
    measured_forward_m: Estimate
    measured_left_m: Estimate
    measured_turn_rad: Estimate
    why: str | None = None


@dataclass(frozen=True)
class BodyConnection:
    """First-order model xi = A r' + B (r - r0) of the body's velocity around the mean gait r0.

    Attributes:
        fitted: Whether there is a model.
        why: What it is fitted to, or why there is none.
        gaits: Sessions around one gait.
        condition_number: Of shapes and rates of shape that the gaits show; None where it is
            infinite.
        identified: Whether they show all directions, so that A is known and not only what the
            gaits' own kind of perturbation does.
        joints: The horizontal ones, head to tail.
        modes: Principal modes of all gaits' shapes, at most three.
        phase_rad: Phases of the mean gait.
        shape_rad: r0 at them, one row a mode.
        A: The entries, empty unless identified.
        predicted: Each session, left out of the model that predicts it.
        label: What the model is.
    """

    fitted: bool
    why: str
    gaits: int
    condition_number: float | None = None
    identified: bool = False
    joints: tuple[str, ...] = ()
    modes: tuple[ShapeMode, ...] = ()
    phase_rad: tuple[float, ...] = ()
    shape_rad: tuple[tuple[float, ...], ...] = ()
    A: tuple[ConnectionEntry, ...] = ()
    predicted: tuple[PredictedTravel, ...] = ()
    label: str = EFFECTIVE
