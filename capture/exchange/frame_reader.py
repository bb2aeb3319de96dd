"""Reading files of CAN frames into sessions, whatever their format."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..common.errors import UsageError

if TYPE_CHECKING:
    from .frame_log import FrameLog
    from .import_options import ImportOptions
    from .reports import ImportReport


@dataclass(frozen=True)
class FrameReader:
    """Reads a file of CAN frames.

    Attributes:
        open: Gives the log. Raises ImportFormatError if the file isn't what its format says, also
            while the blocks are taken.
    """

    open: Callable[[Path], AbstractContextManager[FrameLog]]

    holds: str = field(default="holds CAN frames", init=False)
    options: tuple[str, ...] = field(default=("--bus",), init=False)
    several: bool = field(default=False, init=False)

    def into_session(
        self, source: Path, output: Path, options: ImportOptions
    ) -> list[ImportReport]:
        """Write the session of a log; see :func:`.frame_import.import_frames`."""
        from .frame_import import import_frames

        robot = options.described()
        with self.open(source) as log:
            if robot is None:
                raise UsageError(f"{source} {self.holds}: --robot says what they mean")
            report = import_frames(
                source, log, output, robot,
                bus=options.bus, force=options.force, stop=options.stop,
            )  # fmt: skip
        return [report]
