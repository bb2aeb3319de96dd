"""Are two sessions the same, message by message? And where not: from when on?

A twin under the same commands in the same world gives the same bytes. Where something was changed,
the first message that differs says from when on it mattered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from undulog.capture.log.edit.raw_log import RawLog, RawMessage

EVENTS = "/rosout"
"""Events are said in words, which may name what was changed: they are not compared."""

_ALWAYS = 1 << 64


@dataclass(frozen=True)
class Sameness:
    """What two sessions have alike.

    Attributes:
        same: Topics whose messages are the same: times, numbers and bytes.
        differs_s: Topic to the time of its first message that differs, from the session's start
            [s]; a message that only one session has differs.
        one_sided: Topics that only one session has.
        messages: Messages that were looked at, of the first session.
    """

    same: tuple[str, ...]
    differs_s: dict[str, float]
    one_sided: tuple[str, ...]
    messages: int

    @property
    def exact(self) -> bool:
        """Whether nothing differs."""
        return not (self.differs_s or self.one_sided)


def sameness(one: Path, other: Path) -> Sameness:
    """Hold two sessions against each other, topic by topic.

    Args:
        one: A session.
        other: Another one, of the same time.

    Returns:
        What is the same.

    Raises:
        LogError: If one can't be read.
    """
    with RawLog(one) as first, RawLog(other) as second:
        ids = [
            {channel.topic: key for key, channel in log.file.channels.items()}
            for log in (first, second)
        ]
        topics = [topic for topic in ids[0] if topic in ids[1] and topic != EVENTS]
        same: list[str] = []
        differs_s: dict[str, float] = {}
        messages = 0
        for topic in topics:
            pairs = zip_longest(_told(first, ids[0][topic]), _told(second, ids[1][topic]))
            for a, b in pairs:
                messages += a is not None
                if a != b:
                    at_ns = min(told[0] for told in (a, b) if told is not None)
                    differs_s[topic] = (at_ns - first.start_ns) * 1e-9
                    break
            else:
                same.append(topic)
        one_sided = tuple(sorted(({*ids[0]} ^ {*ids[1]}) - {EVENTS}))
    return Sameness(tuple(same), differs_s, one_sided, messages)


def _told(log: RawLog, channel_id: int) -> Iterator[tuple[int, int, bytes]]:
    """Log time, publish time and bytes of a channel's messages."""
    message: RawMessage
    for message in log.messages({channel_id}, 0, _ALWAYS):
        yield message.log_time_ns, message.publish_time_ns, message.data
