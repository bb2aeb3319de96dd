"""What is measured of a session's health: channels, series, joints, buses, the file."""

from __future__ import annotations

from dataclasses import dataclass

from .tallies import Sequence, Timing


@dataclass(frozen=True)
class SeriesHealth:
    """Messages of one channel that carry the same names.

    Attributes:
        topic: The channel's topic.
        names: Joints or values; empty for other types.
        timing: Its rhythm, by header.stamp where there is one, else by log time.
        first_log_ns: First log time [Unix ns].
        last_log_ns: Last log time [Unix ns].
        numbers: How many numbers were looked at.
        nan: How many of them are NaN.
    """

    topic: str
    type_name: str
    names: tuple[str, ...]
    timing: Timing
    first_log_ns: int
    last_log_ns: int
    numbers: int
    nan: int

    @property
    def label(self) -> str:
        """The topic, and the name where it carries only one."""
        return f"{self.topic} ({self.names[0]})" if len(self.names) == 1 else self.topic


@dataclass(frozen=True)
class ChannelHealth:
    """One channel.

    Attributes:
        unread: Messages that can't be decoded.
        sequence: What its sequence numbers prove.
    """

    topic: str
    type_name: str
    count: int
    unread: int
    sequence: Sequence


@dataclass(frozen=True)
class JointHealth:
    """One joint of one JointState topic.

    Attributes:
        at_limit: Part of the angles at or beyond the robot's limits; None without limits.
        frozen_s: Longest time that it stood while its command moved [s]; None without command.
        frozen_at_ns: When that began [Unix ns].
    """

    topic: str
    name: str
    samples: int
    nan: int
    at_limit: float | None
    frozen_s: int | None
    frozen_at_ns: int

    def with_more(self, other: JointHealth) -> JointHealth:
        """Both together, for a joint whose messages carry now these, now those names.

        Args:
            other: The same joint in other messages.

        Returns:
            Counts added, the longer freeze.
        """
        samples = self.samples + other.samples
        held = [(j.at_limit, j.samples) for j in (self, other) if j.at_limit is not None]
        frozen = max(self, other, key=lambda joint: joint.frozen_s or 0)
        return JointHealth(
            topic=self.topic,
            name=self.name,
            samples=samples,
            nan=self.nan + other.nan,
            at_limit=sum(part * n for part, n in held) / sum(n for _, n in held) if held else None,
            frozen_s=frozen.frozen_s,
            frozen_at_ns=frozen.frozen_at_ns,
        )


@dataclass(frozen=True)
class BusHealth:
    """One bus of raw CAN frames.

    Attributes:
        topic: E.g. ``/can/can0``.
        rate_hz: Mean rate [Hz].
        error_frames: Frames that report an error.
        longest_s: Longest time without a frame [s].
        longest_at_ns: When it began [Unix ns].
        load: Mean part of the bitrate, without and with the most stuff bits; None without bitrate.
        peak_load: The same of the busiest second.
    """

    topic: str
    frames: int
    rate_hz: float | None
    error_frames: int
    longest_s: float
    longest_at_ns: int
    load: tuple[float, float] | None
    peak_load: tuple[float, float] | None


@dataclass(frozen=True)
class FileHealth:
    """The container.

    Attributes:
        chunks: Chunks found in the file.
        checked: Chunks whose CRC was computed and fits.
        without_crc: Chunks that carry no CRC.
        damage: What is corrupt, one sentence each.
        truncated: Whether the end is missing.
        indexed: Whether it has the summary and the chunk index.
        notes: What the reader said when it opened the file.
        unfinished: What was put together of a session that was not finalised; empty where it was.
        running: Whether its recorder is still writing.
    """

    chunks: int
    checked: int
    without_crc: int
    damage: tuple[str, ...]
    truncated: bool
    indexed: bool
    notes: tuple[str, ...]
    unfinished: str = ""
    running: bool = False
