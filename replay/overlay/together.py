"""From files to one recording of all of them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture import Session
from undulog.capture.common.files import check_stop
from undulog.capture.common.interruption import StopRequest
from undulog.capture.log.read.signals import JointSignals

from .alignment import Align, align
from .side import convert, names_of, read_side
from .write import Beside, Converted, Place, write_beside

if TYPE_CHECKING:
    import pandas as pd


class StoppableSession(Session):
    """A session that is read for a file that is to be written.

    Once an end is asked for, every read raises what :func:`.check_stop` raises.
    """

    _wanted: tuple[Path, StopRequest | None] | None = None

    def heed(self, output: Path, stop: StopRequest | None) -> None:
        """Look at a request from now on.

        Args:
            output: The file to be written.
            stop: The request; None for none.
        """
        self._wanted = output, stop

    def forget(self) -> None:
        """See :meth:`Session.forget`; called stretch by stretch."""
        self._check()
        super().forget()

    def joint_columns(
        self,
        wanted: Mapping[str, Sequence[str]],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], JointSignals]:
        """See :meth:`Session.joint_columns`."""
        self._check()
        return super().joint_columns(wanted, start_ns=start_ns, stop_ns=stop_ns)

    def table(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> pd.DataFrame:
        """See :meth:`Session.table`."""
        self._check()
        return super().table(topic, start_ns=start_ns, stop_ns=stop_ns)

    def columns(
        self,
        joints: Mapping[str, Sequence[str]],
        tables: Mapping[str, Sequence[str] | None],
    ) -> tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]:
        """See :meth:`Session.columns`."""
        self._check()
        return super().columns(joints, tables)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """See :meth:`Session.messages`."""
        for message in super().messages(topic):
            self._check()
            yield message

    def _check(self) -> None:
        if self._wanted is not None:
            check_stop(*self._wanted)


def bring_together(
    files: Sequence[Path],
    path: Path,
    *,
    names: Sequence[str] | None = None,
    how: Align = Align.TIME,
    place: Place = Place.START,
    on_step: Callable[[int, str], None] = lambda _done, _note: None,
    stop: StopRequest | None = None,
) -> Beside:
    """Convert sessions and bring them together.

    Args:
        files: Two or more sessions; differences are from the first.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        names: What they are called, or None for the files' names.
        how: What happens at once.
        place: Where the bodies are drawn.
        on_step: Told before each of :func:`steps` how many are done, and what comes.
        stop: Looked at now and then; once an end is asked for, nothing is written.

    Returns:
        What was written.

    Raises:
        UsageError: If the names don't fit, or a session has no gait to be aligned by.
        LogError: If a session can't be read, or the file can't be written.
        DataError: If a session holds nothing that can be drawn.
    """
    done = 0

    def step(note: str) -> None:
        nonlocal done
        check_stop(path, stop)
        on_step(done, note)
        done += 1

    called = names_of(files, names)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="undulog-beside-")))
        pairs: list[tuple[Session, str]] = []
        for file, name in zip(files, called, strict=True):
            session = StoppableSession.open(file, column_folder=folder)
            session.heed(path, stop)
            pairs.append((stack.enter_context(session), name))
        step("angles")
        # Aligned before the long part, since that may refuse.
        aligned = align([read_side(session, name) for session, name in pairs], how)
        converted: list[Converted] = []
        for k, ((session, name), one) in enumerate(zip(pairs, aligned, strict=True)):
            step(f"recording of {name}")
            converted.append(Converted(one, *convert(session, folder / f"{k}.rrd")))
        step("side by side")
        return write_beside(converted, path, how, place=place, stop=stop)


def steps(count: int) -> int:
    """How many steps it takes.

    Args:
        count: Number of sessions.

    Returns:
        The number.
    """
    return count + 2
