"""Right statements about a planted fault: the joints, since when, and which kinds.

The kinds follow from physics and from what is logged, never from what the code under test does.
``docs/explanation/faults.md`` gives the same table with the reasons.
"""

from dataclasses import dataclass

STOPPED = frozenset({"jammed", "stalled", "dead", "at_limit"})
"""Mechanical reasons for a joint that stands still."""

LIGHT = frozenset({"dead"})
"""It stands still, and its motor gives no effort."""

LOADED = frozenset({"jammed", "stalled", "at_limit"})
"""It stands still, and its motor pushes."""

PAUSED = frozenset({"intermittent"})
"""It stands still for a part of the time and follows again."""


@dataclass(frozen=True)
class JointTruth:
    """Right statements about one joint.

    Attributes:
        joint: Its place in the chain.
        names: Kinds that name what was planted; one of them must be among the kinds stated.
        allowed: The kinds that the data can't separate; none but these may be stated.
        stands_out: Quantities by which it may stand out instead; if ``names`` is empty, must.
        since_s: Onset [s], None: from the beginning.
        checked: Whether ``log check`` must name it.
        compared: Whether ``compare`` with a healthy session must name it.
    """

    joint: int
    names: frozenset[str] = frozenset()
    allowed: frozenset[str] = frozenset()
    stands_out: frozenset[str] = frozenset()
    since_s: float | None = None
    checked: bool = True
    compared: bool = True


@dataclass(frozen=True)
class Truth:
    """Right statements about a session.

    Attributes:
        joints: Of the faulty joints.
        undecided: Whether so few joints are sound that none can be named for standing out.
    """

    joints: tuple[JointTruth, ...] = ()
    undecided: bool = False


def standing(channels, cause):
    """Return kinds of a joint whose position stands still while its command moves.

    Args:
        channels: What is logged.
        cause: ``pushing`` (a jam), ``dead`` or ``sensor``.

    Returns:
        What can't be told apart.
    """
    if cause == "sensor":
        # Effort, a velocity of its own or a second encoder go on as before: the joint moves.
        if channels.effort or channels.second or channels.velocity == "true":
            return frozenset({"frozen_sensor"})
        return STOPPED | {"frozen_sensor"}
    if channels.effort:
        return LOADED if cause == "pushing" else LIGHT
    # A velocity of zero decides nothing: it may be derived from the same encoder.
    return STOPPED if channels.second else STOPPED | {"frozen_sensor"}


def either(channels, mechanics, sensor, *, cause, fast=False):
    """Return kinds of a fault that mechanics and sensor show alike, effort included.

    Args:
        channels: What is logged.
        mechanics: Kind of the mechanical fault.
        sensor: Kind of the sensor's fault.
        cause: Which of both was planted.
        fast: Whether it happens between two samples: no velocity need show it.

    Returns:
        Both, or the one that a second sensor or, for the sensor's fault, a true velocity proves.
    """
    if channels.second:
        return frozenset({cause})
    if cause == sensor and channels.velocity == "true" and not fast:
        return frozenset({sensor})
    return frozenset({mechanics, sensor})
