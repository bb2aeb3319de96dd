"""Looking back along the gait's phase rather than along time.

Where omega changes, one gait period and the way from the head to joint i are still 2 pi and
(i - 1) |lag| of phase, while the seconds that they take are not known beforehand.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np

from capture.arrays import FloatArray

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


class PeriodHeading:
    """Mean heading over one gait period: what is left when the undulation is taken out."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._integral = PhaseHistory(TURN)
        self._start: float | None = None
        self._last = (0.0, np.zeros(2))
        self._sum = np.zeros(2)

    def step(self, phase: float, heading: float) -> float:
        """Take in a heading.

        Args:
            phase: The gait's phase [rad], never less than in the call before.
            heading: What the compass says [rad], any turn; NaN is left out.

        Returns:
            Circular mean over the last period, over what there is before the first has passed;
            NaN before the first heading.
        """
        vector = np.array([math.cos(heading), math.sin(heading)])
        if math.isfinite(heading):
            if self._start is None:
                self._start, self._last = phase, (phase, vector)
            before, last = self._last
            self._sum = self._sum + 0.5 * (phase - before) * (vector + last)
            self._last = phase, vector
            self._integral.add(phase, self._sum)
        elif self._start is None:
            return math.nan
        covered = min(self._last[0] - self._start, TURN)
        if covered <= 0.0:
            return math.atan2(self._last[1][1], self._last[1][0])
        x, y = self._sum - self._integral.back(np.array([covered]))[0]
        return math.atan2(y, x)


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
