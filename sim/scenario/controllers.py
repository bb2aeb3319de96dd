"""Parameters of the controllers. All distances in m, offsets in rad; the laws: :mod:`.laws`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class ControllerKind(StrEnum):
    """The controllers of the paper.

    ``random-walk``: bio-inspired, with the head's sensors only; turns at random until the target
    is met. ``target-following``: bio-inspired; the compass holds the heading to the target.
    ``corridor``: amplitude adapted to the walls beside the body. ``avoidance``: tech-inspired,
    with all range sensors.
    """

    RANDOM_WALK = "random-walk"
    TARGET_FOLLOWING = "target-following"
    CORRIDOR = "corridor"
    AVOIDANCE = "avoidance"


@dataclass(frozen=True)
class Calibration:
    """What a robot knows of its gait on free ground, by trying it out once.

    Attributes:
        slip_ratio: K of :class:`.sim.control.odometry.SlipOdometry`.
        turn_gain: c of :class:`.sim.control.phase_history.PathHeading`.
        turn_radius_m: Of the turn with the course's largest offset [m].
    """

    slip_ratio: float = 50.0
    turn_gain: float = 1.6
    turn_radius_m: float = 0.42


@dataclass(frozen=True)
class Lookout:
    """What counts as in the way.

    Attributes:
        half_width_m: Half the width of the robot's way [m]: the undulation and a margin.
        memory_s: How long an echo is kept [s]: a gait period, so that the head has swung once.
    """

    half_width_m: float = 0.3
    memory_s: float = 2.0


@dataclass(frozen=True)
class HeadSteering:
    """Bends away from what the head's sensors see, f(d) = sgn f0 exp(-k d).

    Attributes:
        f0: Offset at contact [rad].
        k: How fast it fades [1/m].
        range_m: What is farther is left alone [m].
        margin_m: A side is freer when it is so by more than this [m].
        hold_s: The side of the turn is kept at least so long [s].
        filter_s: Time constant of the offset [s].
    """

    f0: float = 0.22
    k: float = 2.0
    range_m: float = 1.0
    margin_m: float = 0.05
    hold_s: float = 1.0
    filter_s: float = 0.25


@dataclass(frozen=True)
class SideShrinking:
    """Shrinks the amplitude of the joints beside a wall, A~(d) = A (1 - (1 - s) exp(-k d)).

    Attributes:
        smallest: s, A_min / A_max.
        k: How fast it fades [1/m].
        filter_s: Time constant of the amplitude [s].
    """

    smallest: float = 0.3
    k: float = 3.0
    filter_s: float = 0.5


@dataclass(frozen=True)
class TailHaste:
    """Raises omega while an obstacle is near the tail, omega~(d) = omega (1 + g exp(-k d)).

    Attributes:
        gain: g, the share added at contact.
        k: How fast it fades [1/m].
        range_m: What is farther is left alone [m].
        filter_s: Time constant of omega [s].
    """

    gain: float = 0.5
    k: float = 2.0
    range_m: float = 0.4
    filter_s: float = 0.25


@dataclass(frozen=True)
class RandomTurns:
    """Bends at random: offsets drawn evenly from +-largest, kept for times drawn evenly.

    Attributes:
        largest: Of the offsets [rad].
        shortest_s: Shortest time [s].
        longest_s: Longest time [s].
    """

    largest: float = 0.15
    shortest_s: float = 2.0
    longest_s: float = 6.0


@dataclass(frozen=True)
class TargetHeading:
    """Holds the heading to a target whose place the robot was told.

    Attributes:
        gain: Offset per heading error.
        largest: Of the offsets [rad].
        filter_s: Time constant with which the compass puts the reckoned heading right [s].
    """

    gain: float = 0.35
    largest: float = 0.2
    filter_s: float = 2.0


@dataclass(frozen=True)
class Controller:
    """One controller, complete.

    Attributes:
        kind: Which one.
        near_hold_s: How long a reading near a sensor's fold is believed [s].
        calibration: What it knows of its gait.
        lookout: What counts as in the way.
        head: Steering by the head's sensors.
        side: What walls beside the body do; None: nothing.
        tail: What an obstacle at the tail does; None: nothing.
        course: Where to go when nothing is in the way; None: straight ahead.
    """

    kind: ControllerKind
    near_hold_s: float = 1.0
    calibration: Calibration = Calibration()
    lookout: Lookout = Lookout()
    head: HeadSteering = HeadSteering()
    side: SideShrinking | None = None
    tail: TailHaste | None = None
    course: RandomTurns | TargetHeading | None = None
