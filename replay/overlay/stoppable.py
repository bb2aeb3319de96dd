"""A session whose reading ends when that is asked for: converting one goes stretch by stretch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture import Session
from undulog.capture.common.interruption import StopRequest
from undulog.capture.common.part_file import check_stop
from undulog.capture.log.read.signals import JointSignals

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
