"""A joint at the limits of its robot: saturated or stalled, which is neither sensor nor spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Joint

from ..estimators.series import Series
from ..results.artefact import Span
from .scales import spans_of, turns

AT_LIMIT_RAD = 1e-4
"""A position this close to its limit, or beyond it, is at the limit."""

AT_LIMIT = 0.995
"""So large a part of any other limit is at the limit."""

AT_LIMIT_SHARE = 0.01
"""Less of the time at a limit is touching it."""

STALL_SHARE = 0.9
"""Part of the stall torque that a stalled joint gives at least."""

STALL_S = 0.2
DWELL = 3.0
"""Times the turning point of a sine that a joint of unknown stall torque stands still."""

CONSTANT = 0.05
"""Standard deviation over mean below which an effort is constant."""

STANDING = 0.05
"""Standing still: slower than this part of what the joint does at most."""


@dataclass(frozen=True)
class Limits:
    """What one joint can do, from the robot's description.

    Attributes:
        lower: Angle [rad].
        upper: Angle [rad].
        rate: [rad/s].
        torque: At standstill and full voltage [N m].
        current: At standstill and full voltage [A].
        voltage: Of the supply [V].
        known: Whether the servo's values are known rather than assumed.
    """

    lower: float
    upper: float
    rate: float
    torque: float
    current: float
    voltage: float
    known: bool

    @property
    def values(self) -> tuple[float, ...]:
        """All of them, both signs: values at which a channel may stay by itself."""
        sizes = (self.rate, self.torque, self.current, self.voltage)
        return (self.lower, self.upper, *sizes, *(-one for one in sizes))


def limits_of(session: SessionView) -> dict[str, Limits]:
    """Return the limits of the session's joints.

    Args:
        session: An open session; a twin may have run other servos than the robot's own.

    Returns:
        By joint name; empty without a robot description.
    """
    robot = session.robot_as_run
    if robot is None:
        return {}
    # A twin's servos are as they are stated, whatever the robot's may be.
    known = session.run is not None or not {"servo", "joints"} & set(robot.assumed)
    return {joint.name: _limits(joint, known) for joint in robot.joints}


def _limits(joint: Joint, known: bool) -> Limits:
    servo = joint.servo
    return Limits(
        joint.lower,
        joint.upper,
        joint.max_velocity,
        servo.stall_torque,
        servo.supply_v / servo.resistance_ohm,
        servo.supply_v,
        known,
    )


def saturated(one: Series, lower: float, upper: float, slack: float) -> tuple[Span, ...]:
    """Return the stretches in which a channel is at a limit.

    Args:
        slack: This close to a limit is at it.

    Returns:
        The stretches; none if they are less than ``AT_LIMIT_SHARE`` of the samples.
    """
    at = (one.values <= lower + slack) | (one.values >= upper - slack)
    if np.count_nonzero(at) <= AT_LIMIT_SHARE * one.count:
        return ()
    return spans_of(one.t_s, at, join=2)


def stalled(
    effort: Series, position: Series, most: float | None, asked: Series
) -> tuple[Span, ...]:
    """Return the stretches in which a joint pushes with all it has, and stands still.

    Without a known stall torque, a joint has stalled where its effort stays constant at its
    largest value for far longer than a sine at its turning point stands still.

    Args:
        effort: Torque, or motor current.
        most: Torque or current at standstill and full voltage; None where it is not known.
        asked: Its command, or else its position: what it does at most, 95 % of the time less,
            tells what standing still is.

    Returns:
        Stretches of ``STALL_S`` or more.
    """
    largest = float(np.percentile(np.abs(effort.values), 99.5)) if effort.count else 0.0
    pushing = np.abs(effort.values) >= STALL_SHARE * (largest if most is None else most)
    pushing &= largest > 0
    if position.count < 2 or asked.count < 2 or not np.any(pushing):
        return ()
    usual_rate = float(np.percentile(np.abs(np.diff(asked.values)) / np.diff(asked.t_s), 95))
    if usual_rate <= 0:
        return ()
    # Speed over a tenth of a second, so that an encoder's steps and noise are none.
    half = STALL_S / 4
    at = np.flatnonzero(pushing)
    rate = _moved(position, effort.t_s[at], half) / (2 * half)
    pushing[at[np.abs(rate) >= STANDING * usual_rate]] = False
    found = spans_of(effort.t_s, pushing, join=2)
    long = STALL_S
    if most is None:
        edges = turns(asked)
        if edges.size < 2:
            return ()
        # A sine is slower than the share s of its peak speed for 2 arcsin(s) / omega.
        omega = 2 * np.pi / float(np.median(np.diff(edges)))
        long = max(STALL_S, DWELL * 2 * float(np.arcsin(STANDING)) / omega)
        found = tuple(span for span in found if _constant(effort, span))
    return tuple(span for span in found if span[1] - span[0] >= long)


def _constant(effort: Series, span: Span) -> bool:
    """Return whether an effort keeps one value over a span."""
    i, j = np.searchsorted(effort.t_s, span)
    inside = effort.values[i : j + 1]
    return bool(np.std(inside) < CONSTANT * abs(float(np.mean(inside))))


def _moved(position: Series, t_s: FloatArray, half: float) -> FloatArray:
    return position.at(t_s + half) - position.at(t_s - half)
