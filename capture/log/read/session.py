"""The session reader: any log of the log contract, and any ROS bag with joints, as columns.

Opening reads the summary only. Columns are read on request, for a time window if given;
``warnings`` lists the parts that could not be read.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Self

from ...common.amounts import format_size
from ...common.console import plain
from ...common.files import Closing
from ...common.process import threads_or_default
from ...common.remote import as_path
from .open_log import OpenLog
from .session_view import SessionView

if TYPE_CHECKING:
    from ..columns.topics import Channel


_HEAD = "".join(f"<th>{name}</th>" for name in ("topic", "type", "messages", "rate [Hz]", "unit"))

MOST_TOPICS = 40
"""Rows of the table at most."""


def session_html(session: SessionView) -> str:
    """Return a session as HTML; nothing of it is read that is not read when it is opened."""
    robot = session.robot
    who = "no robot description" if robot is None else f"{robot.name}, {len(robot.joints)} joints"
    verdict = f", verdict {session.verdict}" if session.verdict else ""
    head = f"{session.path.name}: {who}, {_length(session)}{verdict}, {format_size(session.size)}"
    topics = sorted(session.channels.items())
    rows = "".join(_row(channel, session.duration_s) for _, channel in topics[:MOST_TOPICS])
    left = len(topics) - MOST_TOPICS
    more = f"<p>{left} more topics in channels</p>" if left > 0 else ""
    remarks = "".join(f"<li>{_text(warning)}</li>" for warning in session.warnings)
    warnings = f"<details open><summary>warnings</summary><ul>{remarks}</ul></details>"
    return (
        f"<p><strong>{_text(head)}</strong></p><table><thead><tr>{_HEAD}</tr></thead>"
        f"<tbody>{rows}</tbody></table>"
        f"{more}{warnings if remarks else ''}"
    )


def _row(channel: Channel, seconds: float) -> str:
    rate = f"{channel.count / seconds:.4g}" if seconds > 0 else ""
    unit = channel.metadata.get("unit", "")
    cells = (channel.topic, channel.type_name, str(channel.count), rate, unit)
    return f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in cells)}</tr>"


def _length(session: SessionView) -> str:
    if not any(channel.count for channel in session.channels.values()):
        return "no messages"
    start = datetime.fromtimestamp(session.start_ns // 1_000_000_000, UTC)
    return f"{session.duration_s:.2f} s from {start:%Y-%m-%d %H:%M:%S} UTC"


def _text(text: str) -> str:
    return escape(plain(text))


class Session(Closing, SessionView):
    """A recorded session, opened for reading: a view of the whole, which can be closed.

    Example::

        with undulog.Session.open("run.mcap") as session:
            positions = session.joints("/joint_states", "position")
    """

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
        return session_html(self)

    def close(self) -> None:
        """Release the file."""
        self._log.file.close()
