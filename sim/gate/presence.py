"""Who is on the bus: the robot that is to be driven, another one, or somebody who drives it."""

from __future__ import annotations

from collections import Counter

import numpy as np

from undulog.capture.bus.map_entry import bus_messages, frame_id
from undulog.capture.common.arrays import IntArray
from undulog.capture.log.messages.frames import (
    DIR_RX,
    ERROR_FLAG,
    REMOTE_FLAG,
    FrameArray,
    identifier_text,
)
from undulog.capture.robot.model import Direction, Robot
from undulog.capture.sources.events import BUS_OFF

from .outcome import FaultKind, GateFault

_SHOWN = 6


class Presence:
    """Counts what is heard by identifier, and finds what must not be there."""

    def __init__(self, robot: Robot) -> None:
        """Hear nothing yet.

        Args:
            robot: The robot; it has a bus map.

        Raises:
            DataError: If it has no bus.
        """
        bus, messages = bus_messages(robot)
        self._robot_name = robot.name
        self._known = _sorted({frame_id(message) for message in messages.values()})
        told = {s.message for s in bus.signals if s.direction is Direction.RX}
        taken = {s.message for s in bus.signals if s.direction is Direction.TX}
        replies = {frame_id(messages[name]) for name in told}
        requests = {frame_id(messages[name]) for name in taken}
        # Where a request and its reply share an identifier, hearing it tells nothing.
        self._commands = _sorted(requests - replies)
        self.known = 0
        """Frames that the robot's databases know."""
        self.strange: Counter[int] = Counter()
        """Identifier to number of frames that they don't."""

    def add(self, frames: FrameArray) -> GateFault | None:
        """Take what came.

        Args:
            frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).

        Returns:
            What must end a drive: bus-off, or commands that somebody else sends.
        """
        ids = frames["id_flags"]
        errors = (ids & ERROR_FLAG) != 0
        if (ids[errors] & BUS_OFF).any():
            return GateFault(
                FaultKind.BUS_OFF, "bus-off: a controller left the bus, and nobody may hear it"
            )
        data = ids[~errors & ((ids & REMOTE_FLAG) == 0) & (frames["dir"] == DIR_RX)]
        data = data.astype(np.int64)
        known = np.isin(data, self._known)
        self.known += int(known.sum())
        if not known.all():
            self.strange.update(data[~known].tolist())
        others = data[np.isin(data, self._commands)]
        if not len(others):
            return None
        return GateFault(
            FaultKind.STRANGER,
            f"somebody else commands {self._robot_name} on this bus: frame "
            f"{identifier_text(int(others[0]))} was heard; end that controller first",
        )

    def another_robot(self) -> str | None:
        """Why this can't be the robot; None if it may be."""
        if self.strange.total() <= self.known:
            return None
        listed = ", ".join(
            identifier_text(identifier) for identifier, _ in self.strange.most_common(_SHOWN)
        )
        return (
            f"another robot is on this bus: of {self.strange.total() + self.known} frames heard "
            f"{self.known} are of {self._robot_name}; others have the identifiers {listed}"
        )


def _sorted(identifiers: set[int]) -> IntArray:
    return np.array(sorted(identifiers), dtype=np.int64)
