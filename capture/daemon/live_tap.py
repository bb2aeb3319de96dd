"""A tap in front of a session's sink: what is kept is also offered to whoever watches."""

from __future__ import annotations

from mcap.records import Metadata

from ..log.sink import Description, MessageSink
from .live_feed import LiveFeed


class LiveTap:
    """A sink that keeps everything in another one, and offers a live feed what was kept."""

    def __init__(self, sink: MessageSink, feed: LiveFeed) -> None:
        """Put the tap in front.

        Args:
            sink: Where everything is kept.
            feed: Who is offered it then.
        """
        self._sink, self._feed = sink, feed
        self._keep, self._offer = sink.write, feed.offer

    def define(self, record: Description) -> None:
        """Take what explains later messages.

        Args:
            record: See :class:`capture.log.sink.MessageSink`.

        Raises:
            LogWriteError: If it can't be kept.
        """
        self._sink.define(record)
        self._feed.define(record)

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
            LogWriteError: If it can't be kept; it is not offered then.
        """
        self._keep(channel_id, log_time_ns, publish_time_ns, sequence, payload)
        self._offer(channel_id, log_time_ns, publish_time_ns, sequence, payload)

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Finalise what is kept; the feed is closed by whoever made it.

        Args:
            last: Metadata that belong at the end.

        Raises:
            LogWriteError: If it can't be finalised.
        """
        self._sink.close(last)
