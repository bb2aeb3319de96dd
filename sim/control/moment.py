"""The control tick as the parts of a controller see it."""

from __future__ import annotations

from typing import NamedTuple

from ..gait.contract import Readings
from .reckoning import Pose


class Moment(NamedTuple):
    """One control tick.

    Attributes:
        time_s: Since the start [s].
        elapsed_s: Since the tick before [s].
        phase: The gait's phase, of the horizontal plane's first joint [rad].
        pose: Where the robot reckons it is.
        readings: What it has been told by now.
    """

    time_s: float
    elapsed_s: float
    phase: float
    pose: Pose
    readings: Readings
