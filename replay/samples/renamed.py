"""A bag of another make, seen as if its joints were on the topics of the log contract."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

from undulog.capture import Session
from undulog.capture.common.errors import MissingChannelError
from undulog.capture.log.columns.topics import Channel
from undulog.capture.log.read.signals import JointSignals

if TYPE_CHECKING:
    import pandas as pd

COMMANDS = "/joint_commands"
STATES = "/joint_states"


class RenamedSession(Session):
    """A session some of whose topics go by other names; whatever had these is left out."""

    _names: Mapping[str, str] = MappingProxyType({})

    @classmethod
    def with_joints(
        cls,
        path: Path,
        *,
        command_topic: str,
        response_topic: str,
        column_folder: Path | None = None,
    ) -> Self:
        """Open a bag and say where its joints are.

        Args:
            path: The file.
            command_topic: JointState topic of the commands; ``/joint_commands`` may be missing.
            response_topic: JointState topic of the responses; ``/joint_states`` may be missing.
            column_folder: Where large columns lie in files, as for :class:`.capture.Session`.

        Returns:
            The session.

        Raises:
            LogError: If it can't be opened.
            MissingChannelError: If it has no topic of a name that was given.
        """
        session = cls(path, column_folder=column_folder)
        logged = session.channels
        names = {COMMANDS: command_topic, STATES: response_topic}
        for usual, topic in names.items():
            if topic != usual and topic not in logged:
                session.close()
                raise MissingChannelError(path, topic, sorted(logged))
        session._names = {
            usual: topic for usual, topic in names.items() if topic != usual or topic in logged
        }
        return session

    @property
    def channels(self) -> Mapping[str, Channel]:
        """Topic to channel, by the names that they go by."""
        logged = super().channels
        if not self._names:
            return logged
        away = {*self._names, *self._names.values()}
        found = {usual: replace(logged[topic], topic=usual) for usual, topic in self._names.items()}
        found |= {topic: channel for topic, channel in logged.items() if topic not in away}
        return MappingProxyType(found)

    def joint_columns(
        self,
        wanted: Mapping[str, Sequence[str]],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], JointSignals]:
        """Several quantities in one pass, as :meth:`.capture.Session.joint_columns`."""
        logged = {self._logged(topic): fields for topic, fields in wanted.items()}
        found = super().joint_columns(logged, start_ns=start_ns, stop_ns=stop_ns)
        usual = {self._logged(topic): topic for topic in wanted}
        return {(usual[topic], field): one for (topic, field), one in found.items()}

    def table(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> pd.DataFrame:
        """All numbers of a topic, as :meth:`.capture.Session.table`."""
        return super().table(self._logged(topic), start_ns=start_ns, stop_ns=stop_ns)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """A topic message by message, as :meth:`.capture.Session.messages`."""
        return super().messages(self._logged(topic))

    def _logged(self, topic: str) -> str:
        return self._names.get(topic, topic)
