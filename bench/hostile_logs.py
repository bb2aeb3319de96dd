"""Logs that claim more than they hold, and logs with one dimension made large.

Written record by record, so that every number in them can be wrong. Tests and ``bench/limits.py``
share them.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

from undulog.capture.log.messages.cdr import encode
from undulog.capture.log.messages.definitions import message_type, schema_text

EPOCH_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = 9, 10, 11, 12
DATA_END = 15

_JOINT_STATE = message_type("sensor_msgs/msg/JointState")
Message = tuple[int, int, bytes]
"""Channel, log time [Unix ns], message."""


def record(opcode: int, body: bytes) -> bytes:
    """Return a record of the container."""
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    """Return a string of the container."""
    return struct.pack("<I", len(value.encode())) + value.encode()


def array(body: bytes) -> bytes:
    """Return a map or an array of the container."""
    return struct.pack("<I", len(body)) + body


@dataclass
class HostileLog:
    """A file in the making."""

    data: bytearray = field(default_factory=lambda: bytearray(MAGIC))
    schemas: list[bytes] = field(default_factory=list[bytes])
    channels: list[bytes] = field(default_factory=list[bytes])
    chunk_indexes: list[bytes] = field(default_factory=list[bytes])
    attachment_indexes: list[bytes] = field(default_factory=list[bytes])
    counts: dict[int, int] = field(default_factory=dict[int, int])

    def __post_init__(self) -> None:
        """Begin the file."""
        self.data += record(HEADER, text("ros2") + text("another make"))

    def schema(self, name: str = "sensor_msgs/msg/JointState", body: str | None = None) -> int:
        """Define a type; returns its id."""
        body = schema_text(name) if body is None else body
        number = len(self.schemas) + 1
        made = struct.pack("<H", number) + text(name) + text("ros2msg") + text(body)
        self.schemas.append(record(SCHEMA, made))
        self.data += self.schemas[-1]
        return number

    def channel(self, topic: str, schema: int, facts: Mapping[str, str] | None = None) -> int:
        """Define a channel; returns its id."""
        number = len(self.channels) + 1
        pairs = b"".join(text(key) + text(value) for key, value in (facts or {}).items())
        made = struct.pack("<HH", number & 0xFFFF, schema) + text(topic) + text("cdr")
        self.channels.append(record(CHANNEL, made + array(pairs)))
        self.data += self.channels[-1]
        return number

    def attachment(self, name: str, content: bytes, *, listed: int = 1) -> None:
        """Attach a file, listed in the summary once or more often."""
        at = len(self.data)
        made = struct.pack("<QQ", EPOCH_NS, EPOCH_NS) + text(name) + text("text/plain")
        made += struct.pack("<Q", len(content)) + content
        self.data += record(ATTACHMENT, made + struct.pack("<I", 0))
        entry = struct.pack("<QQQQQ", at, len(self.data) - at, EPOCH_NS, EPOCH_NS, len(content))
        entry += text(name) + text("text/plain")
        self.attachment_indexes += [record(ATTACHMENT_INDEX, entry)] * listed

    def chunk(
        self,
        messages: Sequence[Message] = (),
        *,
        compression: str = "zstd",
        packed: bytes | None = None,
        size: int | None = None,
        times: tuple[int, int] | None = None,
        listed: int = 1,
        index: Mapping[int, Sequence[tuple[int, int]]] | None = None,
        cut: int | None = None,
    ) -> int:
        """Add a chunk with its message indexes.

        Args:
            messages: What is in it.
            compression: As the record states it.
            packed: The compressed bytes; None for those of the messages.
            size: Uncompressed size that the record states; None for the true one.
            times: First and last log time that it states; None for the true ones.
            listed: How often the summary lists it.
            index: Channel to log time and offset of each message; None for the true ones.
            cut: The file ends after so many of the compressed bytes.

        Returns:
            Where the compressed bytes begin in the file.
        """
        plain, offsets = bytearray(), dict[int, list[tuple[int, int]]]()
        for channel, t_ns, message in messages:
            offsets.setdefault(channel, []).append((t_ns, len(plain)))
            head = struct.pack("<HIQQ", channel, 0, t_ns, t_ns)
            plain += record(MESSAGE, head + message)
            self.counts[channel] = self.counts.get(channel, 0) + 1
        stamps = [t_ns for _, t_ns, _ in messages] or [0]
        first, last = times or (min(stamps), max(stamps))
        packed = PACK[compression](bytes(plain)) if packed is None else packed
        head = struct.pack("<QQQI", first, last, len(plain) if size is None else size, 0)
        head += text(compression) + struct.pack("<Q", len(packed))
        at = len(self.data)
        self.data += struct.pack("<BQ", CHUNK, len(head) + len(packed)) + head
        payload = len(self.data)
        self.data += packed[:cut]
        length, index_at = len(self.data) - at, len(self.data)
        places = bytearray()
        for channel, entries in (offsets if index is None else index).items():
            places += struct.pack("<HQ", channel, len(self.data))
            body = struct.pack("<H", channel)
            self.data += record(MESSAGE_INDEX, body + array(np.array(entries, "<u8").tobytes()))
        entry = struct.pack("<QQQQ", first, last, at, length) + array(bytes(places))
        entry += struct.pack("<Q", len(self.data) - index_at) + text(compression)
        entry += struct.pack("<QQ", len(packed), len(plain) if size is None else size)
        self.chunk_indexes += [record(CHUNK_INDEX, entry)] * listed
        return payload

    def write(self, path: Path, *, summary: bool = True) -> Path:
        """End the file and write it; without a summary it ends as a killed recorder leaves it."""
        if summary:
            self.data += record(DATA_END, struct.pack("<I", 0))
            start = len(self.data)
            pairs = b"".join(struct.pack("<HQ", key, n) for key, n in self.counts.items())
            counts = (sum(self.counts.values()), len(self.schemas), len(self.channels))
            more = (len(self.attachment_indexes), 0, len(self.chunk_indexes), 0, 2**62)
            statistics = struct.pack("<QHIIIIQQ", counts[0], counts[1], counts[2], *more)
            self.data += b"".join(
                [*self.schemas, *self.channels, record(STATISTICS, statistics + array(pairs))]
            )
            self.data += b"".join([*self.chunk_indexes, *self.attachment_indexes])
            self.data += record(FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC
        path.write_bytes(self.data)
        return path


def joint_state(
    t_ns: int, names: Sequence[str], position: Iterable[float], *, stamp_ns: int | None = None
) -> bytes:
    """Return a JointState in CDR, its velocity and effort empty."""
    seconds, rest = divmod(t_ns if stamp_ns is None else stamp_ns, NS)
    stamp = {"sec": seconds, "nanosec": rest}
    values = {"header": {"stamp": stamp}, "name": list(names), "position": [*position]}
    return encode(_JOINT_STATE, values)


@cache
def zeros(size: int, *, stated: bool = True, opening: bytes = b"") -> bytes:
    """Return a zstd frame of zeros after some bytes; gigabytes take a few hundred kilobytes.

    Args:
        size: Of all of it [byte].
        stated: Whether the frame states its size.
        opening: How it begins.
    """
    packer = zstandard.ZstdCompressor().compressobj(size=size if stated else -1)
    made = [packer.compress(opening)]
    left, piece = size - len(opening), bytes(1 << 24)
    while left:
        made.append(packer.compress(piece[: min(left, len(piece))]))
        left -= min(left, len(piece))
    return b"".join([*made, packer.flush()])


@cache
def lz4_zeros(size: int) -> bytes:
    """Return the same as an lz4 frame."""
    packer = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    made = [packer.begin()]
    made += [packer.compress(bytes(min(1 << 24, size - at))) for at in range(0, size, 1 << 24)]
    return b"".join([*made, packer.flush()])


PACK: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
}


def gait(
    path: Path,
    *,
    ticks: int = 2000,
    joints: int = 3,
    jumps: Mapping[int, int] | None = None,
    log_jumps: Mapping[int, int] | None = None,
    rate_hz: int = 100,
) -> Path:
    """Write joints that follow a sine of 1 Hz; the clock jumps before some ticks.

    Args:
        path: The file.
        ticks: Samples of each joint.
        joints: How many.
        jumps: Tick to how far the stamps jump there [ns].
        log_jumps: The same of the log times.
        rate_hz: Sampling rate.

    Returns:
        The file.
    """
    log = HostileLog()
    kind = log.schema()
    command, state = (log.channel(topic, kind) for topic in ("/joint_commands", "/joint_states"))
    names = [f"joint{k + 1:02d}" for k in range(joints)]
    rng = np.random.default_rng(3)
    stamp = logged = EPOCH_NS
    batch: list[Message] = []
    for tick in range(ticks):
        stamp += (jumps or {}).get(tick, 0) + NS // rate_hz
        logged += (log_jumps or {}).get(tick, 0) + NS // rate_hz
        phase = 2 * np.pi * tick / rate_hz - np.arange(joints)
        asked, came = 0.4 * np.sin(phase), 0.36 * np.sin(phase - 0.3)
        came = came + rng.normal(scale=1e-3, size=joints)
        batch.append((command, logged, joint_state(logged, names, asked, stamp_ns=stamp)))
        batch.append((state, logged, joint_state(logged, names, came, stamp_ns=stamp)))
        if len(batch) >= 2000 or tick == ticks - 1:
            log.chunk(batch)
            batch = []
    return log.write(path)
