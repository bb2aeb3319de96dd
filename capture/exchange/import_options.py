"""Options of an import, whatever the format of the log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..common.process import StopRequest
    from ..robot.model import Robot
    from .table_file import TableFile


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import, each for the formats whose reader names it.

    Attributes:
        robot: The robot that made the log: a name or a file; None if not given.
        commands: A table of commands, where the log is one of states.
        columns: File of a column map.
        map: The same as options.
        units: ``QUANTITY=UNIT``, for the guess of a map.
        write_map: Where to write the map.
        fps: Rows a second of a table without times.
        episode: The one episode of a data set; all of them if None.
        bus: The bus to decode.
        topics: Of commands and responses of a bag; None for those of the log contract.
        force: Replace an existing output.
        stop: Ends the import early, with a whole file of what was read so far.
    """

    robot: str | Path | None = None
    commands: TableFile | None = None
    columns: Path | None = None
    map: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    write_map: Path | None = None
    fps: float | None = None
    episode: int | None = None
    bus: str | None = None
    topics: tuple[str, str] | None = None
    force: bool = False
    stop: StopRequest | None = None

    def described(self) -> Robot | None:
        """Return the robot's description; None if none was given.

        Raises:
            UndulogError: If it can't be read, or its name isn't known.
        """
        from ..robot.description import load_robot

        return None if self.robot is None else load_robot(self.robot)
