"""A sink that others may listen to: live health and live view see what was accepted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from mcap.records import Metadata

from ..log.sinks.sink import Description, MessageSink


class Listener(Protocol):
    """Is told of records after the sink has accepted them; must not wait and must not fail."""

    def define(self, record: Description) -> None:
        """Hear of what explains later messages.

        Args:
            record: The record.
        """
        ...

    def offer(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """Hear of a message; the arguments are those of :meth:`MessageSink.write`."""
        ...


class TappedSink:
    """Passes everything to a sink, and what that accepted to the listeners."""

    def __init__(self, sink: MessageSink, listeners: Sequence[Listener]) -> None:
        """Listen to a sink.

        Args:
            sink: Where everything goes first; what it refuses nobody hears of.
            listeners: Who hears of it then.
        """
        self._sink = sink
        self._write = sink.write
        self._listeners = tuple(listeners)
        self._offers = tuple(listener.offer for listener in listeners)

    def define(self, record: Description) -> None:
        """Take what explains later messages.

        Args:
            record: The record.

        Raises:
            LogWriteError: If the sink can't keep it.
        """
        self._sink.define(record)
        for listener in self._listeners:
            listener.define(record)

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """See :meth:`MessageSink.write`."""
        self._write(channel_id, log_time_ns, publish_time_ns, sequence, payload)
        for offer in self._offers:
            offer(channel_id, log_time_ns, publish_time_ns, sequence, payload)

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Finalise the sink.

        Args:
            last: Metadata that belong at the end.

        Raises:
            LogWriteError: If it can't be finalised.
        """
        self._sink.close(last)
