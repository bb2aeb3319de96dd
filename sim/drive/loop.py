"""The control loop over a bus: read, ask the gait, encode, send; once a control period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from capture.bus.encoding import BusEncoder, BusValue
from capture.errors import SourceError
from capture.interruption import StopRequest
from capture.log.frames import FrameArray
from capture.robot import Direction, Quantity, Robot

from ..gait import GaitTick
from ..scenario import CONTROL_RATE_HZ
from .fading import FadingGait
from .link import Link, VirtualRobotLink
from .pace import Pace
from .readings_from_bus import BusReadings

LOST_S = 0.5
"""A robot that takes commands and is silent for so long is lost [s]."""


class BusTick(NamedTuple):
    """One tick of the loop.

    Attributes:
        tick: Its number, from 0.
        gait: What the gait commands from here on.
        received: Frames that came by then.
        frames: The commands as frames.
    """

    tick: int
    gait: GaitTick
    received: Sequence[FrameArray]
    frames: FrameArray

    @property
    def time_s(self) -> float:
        """Time since the first tick [s]."""
        return self.tick / CONTROL_RATE_HZ


@dataclass
class LoopTally:
    """How a loop went.

    Attributes:
        ticks: Ticks taken.
        overruns: Ticks left out because the one before took too long.
        duration_s: Time of the last tick.
        sent: Frames sent.
        received: Frames that came.
        decoded: Frames of these with something that the robot's map names.
        complete: Whether it reached its planned end.
    """

    ticks: int = 0
    overruns: int = 0
    duration_s: float = 0.0
    sent: int = 0
    received: int = 0
    decoded: int = 0
    complete: bool = False


class CommandEncoder:
    """Commands as frames of a robot's bus."""

    def __init__(self, robot: Robot) -> None:
        """Compile.

        Args:
            robot: The robot.

        Raises:
            DataError: If it has no bus, or takes commands in frames that can't be sent.
        """
        self._encoder = BusEncoder(robot, Direction.TX)
        self._keys: list[BusValue] = [(name, Quantity.COMMAND, "") for name in robot.joint_names]

    def frames(self, tick: GaitTick, t_ns: int = 0) -> FrameArray:
        """The frames of one tick.

        Args:
            tick: What the gait says.
            t_ns: Time of the frames [ns].

        Returns:
            Records of :data:`capture.log.frames.FRAME_DTYPE`.
        """
        return self._encoder.encode(dict(zip(self._keys, tick.command.tolist(), strict=True)), t_ns)


def control(
    gait: FadingGait,
    robot: Robot,
    link: Link,
    pace: Pace,
    *,
    duration_s: float,
    stop: StopRequest,
    on_tick: Callable[[BusTick], None],
) -> LoopTally:
    """Run the loop until its planned end, or until it was asked to stop and has come to rest.

    Args:
        gait: Who commands.
        robot: Whose bus it is.
        link: The bus; commands are sent if it is a virtual robot's.
        pace: When the ticks are.
        duration_s: Time of the last tick.
        stop: Looked at in each tick.
        on_tick: Told of each tick after the commands are sent.

    Returns:
        How it went.

    Raises:
        DataError: If the robot has no bus.
        SourceError: If the robot is lost, or the bus.
    """
    encoder, known, tally = CommandEncoder(robot), BusReadings(robot), LoopTally()
    last = round(duration_s * CONTROL_RATE_HZ)
    while not gait.at_rest:
        tick, received = pace.next()
        tick = min(tick, last)  # where ticks are left out, the last one may be among them
        time_s = tick / CONTROL_RATE_HZ
        for frames in received:
            known.add(frames, time_s)
            tally.received += len(frames)
        if stop.requested:
            gait.begin()
        said = gait.step(time_s, known.readings(time_s))
        commands = encoder.frames(said)
        if isinstance(link, VirtualRobotLink):
            if min(known.silence_s(time_s), time_s) > LOST_S:
                raise SourceError(link.place, f"the robot is lost: silent for {LOST_S:g} s")
            link.send(commands)
            tally.sent += len(commands)
        tally.ticks += 1
        tally.decoded = known.tally.decoded
        tally.overruns, tally.duration_s = pace.overruns, time_s
        on_tick(BusTick(tick, said, received, commands))
        if tick >= last:
            tally.complete = True
            break
    return tally
