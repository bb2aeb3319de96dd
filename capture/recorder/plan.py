"""Which robot a recording is of, and which of its sources is that robot's bus."""

from __future__ import annotations

from collections.abc import Sequence

from ..common.errors import UsageError
from ..robot.description import load_robot
from ..robot.model import Robot
from ..sources.contract import Source
from .settings import RecordSettings


def robot_of(settings: RecordSettings, sources: Sequence[Source]) -> Robot | None:
    """The robot that is recorded: named by the settings, or brought by a source.

    Args:
        settings: The settings.
        sources: The sources.

    Returns:
        The robot; None where nobody says which.

    Raises:
        UsageError: If there would be several.
        RobotFileError: If a description has faults.
    """
    brought = {source.robot.name: source.robot for source in sources if source.robot is not None}
    if settings.robot is None:
        if len(brought) > 1:
            raise UsageError(f"the sources bring different robots: {', '.join(brought)}")
        return next(iter(brought.values()), None)
    robot = load_robot(settings.robot)
    if brought and robot.name not in brought:
        raise UsageError(
            f"--robot {settings.robot}, but the twin brings the robot {', '.join(brought)}; "
            "leave --robot out"
        )
    return robot


def decoded_source(
    settings: RecordSettings, sources: Sequence[Source], robot: Robot | None
) -> str | None:
    """The source whose frames are the robot's bus; the others are kept raw.

    Args:
        settings: The settings; ``bus`` names it.
        sources: The sources.
        robot: The robot.

    Returns:
        Its name; None where no frames can be decoded.

    Raises:
        UsageError: If there is no such source, or it is not clear which one it is.
    """
    buses = [source.name for source in sources if source.robot is None]
    if settings.bus is not None:
        if settings.bus not in buses:
            raise UsageError(f"--bus {settings.bus}: no such bus; there are: {', '.join(buses)}")
        if robot is None or robot.bus is None:
            raise UsageError(f"--bus {settings.bus} needs a robot with a bus map (--robot)")
        return settings.bus
    if robot is None or robot.bus is None or len(buses) < len(sources):
        return None
    if len(buses) > 1:
        raise UsageError(
            f"which of {', '.join(buses)} is the bus of {robot.name}? --bus NAME says so; the "
            "others are kept raw"
        )
    return buses[0] if buses else None
