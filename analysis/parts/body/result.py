"""Motion, shape and travel of the whole body."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.estimate import Estimate


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
