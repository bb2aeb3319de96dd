"""The session reader: any log of the log contract, and any ROS bag with joints, as columns.

Opening reads the summary only. Columns are read on request, for a time window if given;
``warnings`` lists the parts that could not be read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Self

from ...common.process import threads_or_default
from ...common.remote import as_path
from .open_log import OpenLog
from .session_view import SessionView


class Session(SessionView):
    """A recorded session, opened for reading: a view of the whole, which can be closed."""

    def __init__(
        self,
        path: Path | str,
        *,
        threads: int | None = None,
        column_folder: Path | None = None,
        robot: str | Path | None = None,
        on_copied: Callable[[float], None] = lambda _: None,
    ) -> None:
        """See :meth:`open`."""
        number = threads_or_default(threads)
        super().__init__(OpenLog(as_path(path), column_folder, number, robot, on_copied))

    @classmethod
    def open(
        cls,
        path: Path | str,
        *,
        threads: int | None = None,
        column_folder: Path | None = None,
        robot: str | Path | None = None,
        on_copied: Callable[[float], None] = lambda _: None,
    ) -> Self:
        """Open a session; the same as calling the class.

        Args:
            path: The MCAP file, or its URL; of a split session any part, or the folder that holds
                it; a rosbag2 folder of any storage, a ``.db3`` file or a ``.bag`` of ROS 1 (extra
                ``bags``).
            threads: Number of decompressing threads; None for one per core that this process may
                use, at most four.
            column_folder: A folder on a disk for large columns, in files without names, so that
                :meth:`forget` can release their memory (Linux). None for memory.
            robot: Description of the robot of a log that has none, a name or a file; a log with
                one keeps its own, with a warning.
            on_copied: Called with the share of a bag that is copied, 0 to 1; may raise.

        Returns:
            The session, usable in a ``with`` block.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
            InputFileError: If it is a URL that can't be read.
            UsageError: If ``threads`` is less than 1, or there is no such robot.
            RobotFileError: If the description has faults.
            JointSetError: If its joints aren't those of the log.
        """
        return cls(
            path, threads=threads, column_folder=column_folder, robot=robot, on_copied=on_copied
        )

    def _repr_html_(self) -> str:
        """Return what it is, its topics and warnings, for a notebook."""
        from .session_html import session_html

        return session_html(self)

    def close(self) -> None:
        """Release the file."""
        self._log.file.close()

    def __enter__(self) -> Self:
        """Return the session."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the file."""
        self.close()
