"""Parts of a session that are read as if they were all of it: for who can't wait for the whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from undulog.capture import Session
from undulog.capture.log.columns.topics import Channel
from undulog.capture.log.read.signals import JointSignals

from ..samples.renamed import RenamedSession
from ..samples.stretches import STRETCH_NS

if TYPE_CHECKING:
    import pandas as pd

_LOOKS = 8
"""How many stretches after the first one a glimpse looks into, at most."""
_LOOK_NS = 2_000_000_000
"""How long it looks into each of them [ns]."""


class _Part(RenamedSession):
    """A session that reads through another one's open file, which it leaves open."""

    @classmethod
    def _sharing(cls, session: Session, **own: Any) -> Self:
        part = cls.__new__(cls)
        vars(part).update(vars(session), **own)
        return part


class Excerpt(_Part):
    """A session's beginning."""

    _stop_ns: int

    @classmethod
    def until(cls, session: Session, stop_ns: int | None) -> Session:
        """Take the beginning of a session.

        Args:
            session: The session, open.
            stop_ns: One past the last time wanted [Unix ns]; None for all of it.

        Returns:
            The beginning; the session itself where all of it is wanted.
        """
        if stop_ns is None:
            return session
        return cls._sharing(session, _stop_ns=stop_ns)

    @property
    def end_ns(self) -> int:
        """Its end [Unix ns]."""
        return min(super().end_ns, self._stop_ns)

    def joint_columns(
        self,
        wanted: Mapping[str, Sequence[str]],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], JointSignals]:
        """Several quantities in one pass, as :meth:`.capture.Session.joint_columns`."""
        return super().joint_columns(wanted, start_ns=start_ns, stop_ns=self._until(stop_ns))

    def table(
        self, topic: str, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> pd.DataFrame:
        """All numbers of a topic, as :meth:`.capture.Session.table`."""
        return super().table(topic, start_ns=start_ns, stop_ns=self._until(stop_ns))

    def columns(
        self,
        joints: Mapping[str, Sequence[str]],
        tables: Mapping[str, Sequence[str] | None],
    ) -> tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]:
        """Joint signals and tables, as :meth:`.capture.Session.columns`."""
        read = {topic: self.table(topic) for topic in tables}
        found = {
            topic: read[topic] if fields is None else read[topic][list(fields)]
            for topic, fields in tables.items()
        }
        return self.joint_columns(joints) if joints else {}, found

    def _until(self, stop_ns: int | None) -> int:
        return self._stop_ns if stop_ns is None else min(stop_ns, self._stop_ns)


class Glimpse(_Part):
    """A session of which the first stretch is read, and a little of some of the others.

    Enough to choose colours, scales and the joints that stand for the body. Which lines there are
    it tells as far as it looked: :attr:`seen` says what came, so that the rest can be held to it.
    """

    seen: dict[tuple[str, str], set[str]]
    """(topic, field) to the joints of which a sample was read."""

    _every: int

    @classmethod
    def of(cls, session: Session) -> Self:
        """Take a glimpse.

        Args:
            session: The session, open.

        Returns:
            The glimpse, nothing of it read yet; all of a session that is short.
        """
        every = 1 + (session.end_ns - session.start_ns) // (STRETCH_NS * _LOOKS)
        return cls._sharing(session, seen={}, _every=every)

    @property
    def is_whole(self) -> bool:
        """Whether it reads all of the session."""
        return self._every == 1

    @property
    def channels(self) -> Mapping[str, Channel]:
        """Topic to channel; of the messages only those that are read count."""
        logged = super().channels
        if self.is_whole:
            return logged
        share = (STRETCH_NS + _LOOKS * _LOOK_NS) / (self.end_ns - self.start_ns)
        return {topic: _thinned(channel, share) for topic, channel in logged.items()}

    def joint_columns(
        self,
        wanted: Mapping[str, Sequence[str]],
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> dict[tuple[str, str], JointSignals]:
        """Several quantities in one pass, as :meth:`.capture.Session.joint_columns`.

        A stretch that isn't looked into has none.
        """
        if not self.is_whole:
            first_ns = self.start_ns
            start_ns = first_ns if start_ns is None else start_ns
            number = (start_ns - first_ns) // STRETCH_NS
            if number % self._every:
                return {}
            latest_ns = start_ns + (_LOOK_NS if number else STRETCH_NS)
            stop_ns = latest_ns if stop_ns is None else min(stop_ns, latest_ns)
        found = super().joint_columns(wanted, start_ns=start_ns, stop_ns=stop_ns)
        for key, signals in found.items():
            come = zip(signals.names, signals.values, strict=True)
            known = {name for name, values in come if np.isfinite(values).any()}
            self.seen.setdefault(key, set()).update(known)
        return found


def _thinned(channel: Channel, share: float) -> Channel:
    return replace(channel, count=min(channel.count, 1 + round(channel.count * share)))
