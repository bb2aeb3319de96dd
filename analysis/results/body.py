"""The body as a whole: motion of its links, shape over a cycle, travel, and ground contact."""

from __future__ import annotations

from dataclasses import dataclass

from .estimate import Estimate

TWIN_ACCURACY = (0.86, 0.93)
"""How often it is right in the twin: the least and the largest mean, over gaits that lift links, of
the shares of contacts and of lifted links that are recognised (``studies/contact_tables.py``)."""

EFFECTIVE = (
    "effective: exact to first order where friction is viscous; under Coulomb friction, which is "
    "rate-independent but not linear, it holds around this gait only"
)


@dataclass(frozen=True)
class BodyPoint:
    """Transverse motion of one link, at the gait frequency.

    Attributes:
        place: ``head``, ``middle`` or ``tail``.
        amplitude_m: Amplitude across the mean heading.
        phase_rad: Phase relative to the head link.
    """

    place: str
    link: str
    amplitude_m: Estimate
    phase_rad: Estimate


@dataclass(frozen=True)
class BodyResult:
    """Head, middle and tail, with the perfect-tracking null beside them.

    Attributes:
        observed: From the logged head pose and joint angles.
        null: Name of the null's model (``viscous`` or ``free``) to the same three points, with
            every joint exactly on its command.
    """

    plane: str
    observed: tuple[BodyPoint, ...]
    null: dict[str, tuple[BodyPoint, ...]]


@dataclass(frozen=True)
class ShapeMode:
    """One principal mode of the joint angles of a plane.

    Attributes:
        share: Of the variance of all angles, 0 to 1.
        weights: Of each joint, of unit length together.
    """

    share: Estimate
    weights: tuple[float, ...]


@dataclass(frozen=True)
class Serpenoid:
    """The serpenoid curve nearest to the motion of a plane.

    After Hirose, Biologically Inspired Robots, 1993. Joint i has the angle
    offset + amplitude cos(omega t - wave_number i + phase).

    Attributes:
        amplitude_rad: Of every joint.
        wave_number: Lag from joint to joint [rad/joint], positive where the wave runs from the
            first joint to the last.
        phase_rad: Of the first joint at the start of the whole cycles.
        offset_rad: Of every joint.
        waves: Waves between the first and the last joint, without sign.
        speed: Of the wave [joints/s].
        speed_m_s: Of the wave [m/s]; empty without a robot description.
        unexplained: Share of the mean square of all angles about the offset that isn't this curve.
    """

    amplitude_rad: Estimate
    wave_number: Estimate
    phase_rad: Estimate
    offset_rad: Estimate
    waves: Estimate
    speed: Estimate
    speed_m_s: Estimate
    unexplained: Estimate


@dataclass(frozen=True)
class PlaneShape:
    """Shape of the joints of one plane.

    Attributes:
        plane: None without a robot description.
        joints: In chain order.
        modes: The first principal modes, the largest first.
    """

    plane: str | None
    joints: tuple[str, ...]
    modes: tuple[ShapeMode, ...]
    serpenoid: Serpenoid


@dataclass(frozen=True)
class BodyTravel:
    """Mean motion of the virtual chassis over a cycle, on the ground.

    Attributes:
        forward_m: Displacement along the mean heading of the cycle.
        left_m: Displacement across it.
        turn_rad: Change of heading, positive to the left.
        length_m: Root mean square distance of the links from their mean along the body.
        width_m: The same across the body.
    """

    forward_m: Estimate
    left_m: Estimate
    turn_rad: Estimate
    length_m: float
    width_m: float


@dataclass(frozen=True)
class BodyShape:
    """Shape of a periodic motion.

    Attributes:
        planes: Those of at least four moving joints.
        travel: None without the head's pose and a robot description, or where the body curls.
    """

    planes: tuple[PlaneShape, ...] = ()
    travel: BodyTravel | None = None


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


@dataclass(frozen=True)
class LinkContact:
    """Ground contact of one link.

    Attributes:
        link: Name of the link.
        share: Of a cycle that it is on the ground.
        load: Mean load, over the mean weight of a link.
        by_phase: Share of the cycles in which it is on the ground, in successive equal parts of a
            cycle from the start of the whole cycles.
    """

    link: str
    share: Estimate
    load: float
    by_phase: tuple[float, ...]


@dataclass(frozen=True)
class GroundContact:
    """Ground contact of the links, from the torques of the joints.

    Attributes:
        source: Where the torques are from: effort or current.
        links: Head to tail.
        twin_accuracy: How often contact is recognised rightly in the twin: mean of the shares of
            contacts and of lifted links that are recognised, of the worst and the best gait; 0.5
            is chance.
    """

    source: str
    links: tuple[LinkContact, ...]
    twin_accuracy: tuple[float, float] = TWIN_ACCURACY
