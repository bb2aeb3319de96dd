"""Where a session's records go: a file, a file with a write-ahead log, or a ring in memory."""

from __future__ import annotations

from typing import Protocol, TypeAlias

from mcap.records import Attachment, Channel, Metadata, Schema

Description: TypeAlias = Schema | Channel | Attachment | Metadata
"""What explains the messages: it comes before them."""


class MessageSink(Protocol):
    """Takes what a session writer encodes, in order; one thread calls it."""

    def define(self, record: Description) -> None:
        """Take what explains later messages.

        Args:
            record: Schemas before their channels, channels before their messages; the ids are
                given by the session writer, from 1.

        Raises:
            LogWriteError: If it can't be kept.
        """
        ...

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """Take one message.

        Args:
            channel_id: Its channel.
            log_time_ns: When it was recorded [Unix ns].
            publish_time_ns: When it was sampled [Unix ns].
            sequence: The channel's own counter.
            payload: Its bytes.

        Raises:
            LogWriteError: If it can't be kept; it is not in the log then.
        """
        ...

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Finalise; safe to call twice.

        Args:
            last: Metadata that belong at the end, e.g. the health verdict.

        Raises:
            LogWriteError: If it can't be finalised.
        """
        ...
