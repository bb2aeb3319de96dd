"""Looking back along the gait's phase rather than along time.

Where omega changes, one gait period and the way from the head to joint i are still 2 pi and
(i - 1) |lag| of phase, while the seconds that they take are not known beforehand.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np

from undulog.capture.common.arrays import FloatArray

TURN = 2.0 * math.pi
"""One gait period, in phase [rad]."""


class PhaseHistory:
    """A vector as a function of the phase, as far back as asked, straight between its samples."""

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
                heading = last + math.remainder(heading - last, TURN)
            self._rows.append((phase, heading, offset))
            old = bisect_left(self._rows, phase - TURN, key=lambda row: row[0])
            del self._rows[:old]
        if not self._rows:
            return math.nan
        at, psi, bent = np.array(self._rows).T
        span = at[-1] - at[0]
        if span <= 0.0:
            return float(psi[-1])
        turned = self._turn_gain * np.trapezoid(bent * (at - at[0]), at)
        return float((np.trapezoid(psi, at) - turned) / span)


class BodyWave:
    """What the head decided, passed down the body at the speed of the wave.

    Y_i(t) = Y(t - (i - 1) |lag| / omega), the delay taken in phase so that it holds when omega
    changes: each joint bends where the head did, and the body follows the head's path.
    """

    def __init__(self, joint_count: int, lag: float) -> None:
        """Start with a straight body.

        Args:
            joint_count: Joints of the plane.
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
