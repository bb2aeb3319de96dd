"""The session reader: any log to the contract, and any ROS 2 bag with JointStates, as columns.

Opening reads the summary only; :mod:`.capture.log.read.view` has what is read then.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from ...common.threads import threads_or_default
from .open_log import OpenLog
from .view import SessionView


class Session(SessionView):
    """A recorded session, opened for reading: a view of all of it, which can be closed."""

    def __init__(
        self, path: Path | str, *, threads: int | None = None, column_folder: Path | None = None
    ) -> None:
        """See :meth:`open`."""
        super().__init__(OpenLog(Path(path), column_folder, threads_or_default(threads)))

    @classmethod
    def open(
        cls, path: Path | str, *, threads: int | None = None, column_folder: Path | None = None
    ) -> Self:
        """Open a session; the same as calling the class.

        Args:
            path: The MCAP file; of a split session any part, or the folder that holds it.
            threads: How many decompress what is read; None for one a core that this process may
                use, at most four. What is read is the same.
            column_folder: A folder on a disk: large columns lie there, in files without names, and
                :meth:`forget` lets go of their memory (Linux). None for memory.

        Returns:
            The session, usable in a ``with`` block.

        Raises:
            NotALogError: If it is not an MCAP file or nothing in it can be read.
            LogError: If it can't be opened.
            UsageError: If ``threads`` is less than 1.
        """
        return cls(path, threads=threads, column_folder=column_folder)

    def close(self) -> None:
        """Release the file."""
        self._log.file.close()

    def __enter__(self) -> Self:
        """Nothing to do: the file is open."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Release the file."""
        self.close()
