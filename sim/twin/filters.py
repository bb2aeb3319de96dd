"""Filters of the controllers: low pass, latched side, memory, delays in phase, dead reckoning.

A delay looks back along the gait's phase rather than along time.

Where omega changes, one gait period and the way from the head to joint i are still 2 pi and
(i - 1) |lag| of phase, while the seconds that they take are not known beforehand.

Dead reckoning gives position and heading from the encoders alone. A snake that undulates goes where
its links slip least across the body. With the joint angles and rates known, the motion of the head
(v_x, v_y, omega) is what makes the sum over the links of (tangential slip)^2 + K (normal slip)^2
least: the balance of forces and moments of a slender body under viscous drag with the ratio
K = c_n / c_t (after Gray & Hancock 1955). K is the one constant of calibration: large for a robot
on wheels, smaller the more its links slip sideways. It is in plan view: joints that bend the body
vertically count as straight.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import Readings
from ..scenario.motion import Calibration


class PhaseHistory:
    """A vector as a function of the past phase, linear between its samples."""

    def __init__(self, span: float) -> None:
        """Start with nothing.

        Args:
            span: How far one looks back [rad].
        """
        self._span = span
        self._phases: list[float] = []
        self._values: list[FloatArray] = []

    def add(self, phase: float, value: FloatArray) -> None:
        """Add the present value.

        Args:
            phase: The gait's phase [rad]; where it isn't more than before, the last value is
                replaced.
            value: The value, shape (k,).
        """
        if self._phases and phase <= self._phases[-1]:
            self._values[-1] = value
            return
        self._phases.append(phase)
        self._values.append(value)
        old = bisect_left(self._phases, phase - self._span) - 1  # its successor is still needed
        if old > len(self._phases) // 2:
            del self._phases[:old], self._values[:old]

    def back(self, angles: FloatArray) -> FloatArray:
        """Values before the present one.

        Args:
            angles: How far back [rad], 0 to the span, shape (n,).

        Returns:
            Values, the first one where nothing is older, shape (n, k).
        """
        at = self._phases[-1] - angles
        values = np.array(self._values, dtype=np.float64)
        back = np.empty((len(at), values.shape[1]))
        for k in range(values.shape[1]):
            back[:, k] = np.interp(at, self._phases, values[:, k])
        return back

    def least(self) -> FloatArray:
        """The least value of each entry within the span.

        Returns:
            Minima, shape (k,).
        """
        first = bisect_left(self._phases, self._phases[-1] - self._span)
        return np.array(self._values[first:], dtype=np.float64).min(axis=0)


class PathHeading:
    """Which way the path goes: the heading with the undulation taken out, brought up to date.

    The mean over one gait period has no undulation, but it is half a period old. What the head has
    turned since is known from its own offset, d psi / d Phi = -c Y in a steady bend, so that

        h(Phi) = mean(psi) - c / 2 pi * integral of Y(Phi') (Phi' - Phi + 2 pi) d Phi'

    over the last period, Phi - 2 pi <= Phi' <= Phi.
    """

    def __init__(self, turn_gain: float) -> None:
        """Start with nothing.

        Args:
            turn_gain: c, how much the path turns for each radian of offset and of phase.
        """
        self._turn_gain = turn_gain
        self._rows: list[tuple[float, float, float]] = []

    def step(self, phase: float, heading: float, offset: float) -> float:
        """Take in a heading.

        Args:
            phase: The gait's phase Phi [rad], never less than in the call before.
            heading: psi, as a compass gives it [rad], any turn; NaN is left out.
            offset: Y of the head from here on [rad].

        Returns:
            h [rad], on the turn that continues the one before; until a period has passed it is
            taken over what there is; NaN before the first heading.
        """
        if math.isfinite(heading):
            if self._rows:
                last = self._rows[-1][1]
                heading = last + math.remainder(heading - last, math.tau)
            self._rows.append((phase, heading, offset))
            old = bisect_left(self._rows, phase - math.tau, key=lambda row: row[0])
            del self._rows[:old]
        if not self._rows:
            return math.nan
        at, psi, bent = np.array(self._rows).T
        span = at[-1] - at[0]
        if span <= 0.0:
            return float(psi[-1])
        turned = self._turn_gain * np.trapezoid(bent * (at - at[0]), at)
        return float((np.trapezoid(psi, at) - turned) / span)


class PassedWave:
    """What the head decided, passed down the body at the speed of the wave.

    Y_i(t) = Y(t - (i - 1) |lag| / omega), the delay taken in phase so that it holds when omega
    changes: each joint bends where the head did, and the body follows the head's path.
    """

    def __init__(self, joint_count: int, lag: float) -> None:
        """Start with a straight body.

        Args:
            lag: Phase from one joint of the plane to the next, of either sign [rad].
        """
        self._delays: FloatArray = np.arange(joint_count, dtype=np.float64) * abs(lag)
        self._history = PhaseHistory(float(self._delays[-1]))

    def step(self, phase: float, head: float) -> FloatArray:
        """Pass the head's offset on.

        Args:
            phase: The gait's phase [rad].
            head: Y of the first joint [rad].

        Returns:
            Y_i of each joint, head first [rad], shape (joint_count,).
        """
        self._history.add(phase, np.array([head]))
        return self._history.back(self._delays)[:, 0]


_Value = TypeVar("_Value", float, FloatArray)


class LowPass(Generic[_Value]):
    """First-order low pass, T y' = x - y, exact for inputs that are held between two steps."""

    def __init__(self, time_constant_s: float, start: _Value) -> None:
        """Start at rest.

        Args:
            time_constant_s: T [s]; 0 passes everything.
            start: y at the start.
        """
        self._time_constant_s = time_constant_s
        self._value: _Value = start

    def step(self, elapsed_s: float, value: _Value) -> _Value:
        """Follow an input for a while.

        Args:
            elapsed_s: For how long [s].
            value: x, held meanwhile.

        Returns:
            y at the end.
        """
        if self._time_constant_s > 0.0:
            left = math.exp(-elapsed_s / self._time_constant_s)
            self._value = value + (self._value - value) * left
        else:
            self._value = value
        return self._value


class SideLatch:
    """To which side to turn: the freer one, kept a while so that noise can't turn it to and fro."""

    def __init__(self, margin_m: float, hold_s: float) -> None:
        """Start with a turn to the right.

        Args:
            margin_m: The other side must be freer by more than this [m].
            hold_s: A side is kept at least so long [s].
        """
        self._margin_m, self._hold_s = margin_m, hold_s
        self._side = 1.0
        self._since_s = -math.inf

    def step(self, time_s: float, left_m: float, right_m: float) -> float:
        """Choose.

        Args:
            time_s: Now [s].
            left_m: Free way to the left [m]; +inf where nothing is in range.
            right_m: Free way to the right [m].

        Returns:
            +1 to turn right, -1 to turn left; the last side on a tie, at first +1.
        """
        gap = 0.0 if left_m == right_m else right_m - left_m  # no inf - inf
        side = math.copysign(1.0, gap)
        if (
            abs(gap) > self._margin_m
            and side != self._side
            and time_s - self._since_s >= self._hold_s
        ):
            self._side, self._since_s = side, time_s
        return self._side


class NearMemory:
    """Distances of sensors that fold back: an object closer than their peak reads as farther.

    An infrared triangulation sensor (Sharp GP2Y0A02 class) gives its highest voltage at its
    shortest range; nearer than that the voltage falls again. One reading can't tell the two
    branches apart. But an obstacle cannot come onto the near branch without passing the highest
    voltage. So once a reading is that near, nearer than any later one is believed for a while:
    the obstacle stays where it was last seen rather than jumping away.
    """

    def __init__(self, near_m: FloatArray, hold_s: float) -> None:
        """Start with nothing near.

        Args:
            near_m: Readings up to this are near the fold [m], shape (n,); 0 for a sensor that
                does not fold back.
            hold_s: How long a near reading is believed [s].
        """
        self._near_m, self._hold_s = near_m, hold_s
        self._seen_m = np.full(len(near_m), math.inf)
        self._until_s = np.full(len(near_m), -math.inf)

    def step(self, time_s: float, read_m: FloatArray) -> FloatArray:
        """Take in a reading of each sensor.

        Args:
            time_s: Now [s].
            read_m: What the sensors read [m], +inf: nothing in range, shape (n,).

        Returns:
            What to believe [m], never more than what was read, shape (n,).
        """
        held: BoolArray = time_s < self._until_s
        near: BoolArray = read_m <= self._near_m
        believed = np.where(held, np.minimum(self._seen_m, read_m), read_m)
        self._seen_m = np.where(near, believed, np.where(held, self._seen_m, math.inf))
        self._until_s = np.where(near, time_s + self._hold_s, self._until_s)
        return believed


class SlipOdometry:
    """The velocity of the head from joint angles and rates."""

    def __init__(self, robot: Robot, slip_ratio: float) -> None:
        """Take the body's lengths.

        Args:
            slip_ratio: K.
        """
        self._lengths = np.array([link.length for link in robot.links])
        self._horizontal = robot.joint_indices(Plane.HORIZONTAL)
        self._slip_ratio = slip_ratio

    def velocity(self, angle: FloatArray, rate: FloatArray) -> FloatArray:
        """Velocity of the head link's centre, in its own frame, and its yaw rate.

        Args:
            angle: Joint angles [rad], shape (m,).
            rate: Joint rates [rad/s], shape (m,).

        Returns:
            Forward and to the left [m/s], and about z [rad/s], shape (3,).
        """
        turn, spin = self._from_head(angle), self._from_head(rate)
        ahead = np.array([np.cos(turn), np.sin(turn)])
        left = np.array([-ahead[1], ahead[0]])
        half = self._lengths / 2
        # Places and velocities of the links' centres, from the head and as it would see them.
        place = -_summed(half * ahead)
        moved = -_summed(half * spin * left)
        # Slip of a link: its own motion, and v + omega x r of the head's.
        lever = np.array([-place[1], place[0]])
        along = np.column_stack([ahead[0], ahead[1], (ahead * lever).sum(axis=0)])
        across = np.column_stack([left[0], left[1], (left * lever).sum(axis=0)])
        weight = math.sqrt(self._slip_ratio)
        internal = np.concatenate(
            [(ahead * moved).sum(axis=0), weight * (left * moved).sum(axis=0)]
        )
        motion = np.linalg.lstsq(np.concatenate([along, weight * across]), -internal)[0]
        return np.asarray(motion, dtype=np.float64)

    def _from_head(self, joint: FloatArray) -> FloatArray:
        """Sums over the horizontal joints before each link, shape (n,)."""
        bent = np.zeros(len(self._lengths))
        bent[self._horizontal + 1] = joint[self._horizontal]
        return np.cumsum(bent)


def _summed(half: FloatArray) -> FloatArray:
    """From half vectors of the links to sums from the head's centre to theirs, shape (2, n)."""
    return np.cumsum(half, axis=1) + np.cumsum(half, axis=1) - half - half[:, :1]


class Pose(NamedTuple):
    """The head, in the frame in which it started: x ahead, y to the left.

    Attributes:
        place: Of the head link's centre [m], shape (2,).
        heading: Of the head link [rad]; it swings with the gait.
        way: Of the path [rad]; it does not.
    """

    place: FloatArray
    heading: float
    way: float


class DeadReckoning:
    """Integrates the odometry; errors accumulate."""

    def __init__(self, calibration: Calibration, robot: Robot) -> None:
        """Start at the origin.

        Args:
            calibration: Of this robot's gait on this ground.
        """
        self._odometry = SlipOdometry(robot, calibration.slip_ratio)
        self._path = PathHeading(calibration.turn_gain)
        self._place, self._heading = np.zeros(2), 0.0

    def step(self, elapsed_s: float, phase: float, offset: float, readings: Readings) -> Pose:
        """Move on.

        Args:
            elapsed_s: Since the last tick [s].
            phase: The gait's phase [rad].
            offset: Of the head, as the last tick set it [rad].
            readings: Newest readings; nothing moves before the first angles.
        """
        if not np.isnan(readings.angle).any():
            motion = self._odometry.velocity(readings.angle, readings.velocity) * elapsed_s
            self._place = self._place + turned(motion[:2], self._heading + motion[2] / 2)
            self._heading += float(motion[2])
        return Pose(self._place, self._heading, self._path.step(phase, self._heading, offset))


def turned(vectors: FloatArray, angle: float) -> FloatArray:
    """Turn vectors to the left.

    Args:
        vectors: x and y, shape (2,) or (2, k).
        angle: By how much [rad].

    Returns:
        The turned vectors, of the same shape.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vectors
