"""Faults of files: in bytes, in words of a text, in messages of a log, in rows of a database."""

import contextlib
import re
import sqlite3
import struct

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

HUGE = [
    0, 1, 255, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63,
    2**63 + 10**18, 2**64 - 1,
]  # fmt: skip
NUMBERS = [
    "0", "-1", "nan", "inf", "-inf", "1e308", "-1e308", "1e400", "1e-320", "4294967296",
    "9223372036854775808", "18446744073709551616", "9" * 400, "0x10", "1_0", "1e", "-",
    "9300000000.0", "0.1.2", "٣", "1e999999999",
]  # fmt: skip
WORDS = [
    "", "[]", "{}", '"', "'", "=", "\0", "\n", "\r", "\x1b[2J", "\x1b]52;c;eA==\x07", "\x9b31m",
    "{joint}", "@0-", "|", "64|64@0+", "SG_", "BO_", "BU_", "é", "\ufeff", "\u202e", "[[bus]]",
    "[bus]", "true", "=1+1", ",", ";", "\t", "..", "/", "#", "##", "a" * 5000, "[" * 3000,
    "{a=" * 3000, "a." * 3000, "-\n", "x" * 70000,
]  # fmt: skip

DAY_NS = 86_400 * 10**9
JUMPS = [-(10**9), 10**9, 3600 * 10**9, DAY_NS, 365 * DAY_NS, 10**18]
"""By so much a clock jumps once [ns]."""


# -- bytes ---------------------------------------------------------------------------------


def mutate_bytes(data, rng):
    """Return bytes with one to four faults."""
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        if len(changed) < 16:
            break
        rng.choice(FAULTS)(changed, rng)
    return bytes(changed)


def _flip_bits(data, rng):
    for _ in range(rng.choice([1, 1, 3, 20])):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _cut(data, rng):
    del data[rng.randrange(len(data)) :]


def _stretch(change):
    """Return a fault that changes some bytes in a row."""

    def fault(data, rng):
        a, b = sorted(rng.choices(range(len(data)), k=2))
        b = min(b, a + rng.choice([4, 64, 1024, 1 << 20]))
        data[a:b] = change(data[a:b])

    return fault


_zero = _stretch(lambda part: bytes(len(part)))
_take_out = _stretch(lambda part: b"")
_double = _stretch(lambda part: 2 * part)
_swap = _stretch(lambda part: part[len(part) // 2 :] + part[: len(part) // 2])


def _set_number(data, rng):
    """Set a number anywhere, of any width, aligned or not."""
    size = rng.choice([2, 4, 8, 8])
    at = rng.randrange(len(data) - size)
    data[at : at + size] = (rng.choice(HUGE) & ((1 << 8 * size) - 1)).to_bytes(size, "little")


def _set_length(data, rng):
    """Set the length, or a number in the first bytes, of a record of an MCAP."""
    places, at = [], 8
    while at + 9 <= len(data) and len(places) < 10_000:
        places.append(at)
        (length,) = struct.unpack_from("<Q", data, at + 1)
        at += 9 + length
    at = rng.choice(places or [0]) + rng.choice([1, 1, 9, 13, 17, 21, 25, 29, 33, 37, 41, 49])
    if at + 8 <= len(data):
        size = rng.choice([4, 8])
        data[at : at + size] = (rng.choice(HUGE) & ((1 << 8 * size) - 1)).to_bytes(size, "little")


FAULTS = [
    _flip_bits, _flip_bits, _cut, _zero, _take_out, _double, _swap, _set_number, _set_length,
    _set_length,
]  # fmt: skip


# -- text ----------------------------------------------------------------------------------


def mutate_text(data, rng):
    """Return text with one to four faults: in bytes, in words, in numbers, in whole lines."""
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.choice([1, 1, 2, 4])):
        kind = rng.random()
        if kind < 0.15:
            mutated = mutate_bytes(text.encode("utf-8", "surrogateescape"), rng)
            text = mutated.decode("utf-8", "surrogateescape")
        elif kind < 0.6 and (numbers := list(re.finditer(r"[-+]?\d+(\.\d+)?", text))):
            place = rng.choice(numbers)
            text = text[: place.start()] + rng.choice(NUMBERS) + text[place.end() :]
        elif kind < 0.75:
            lines = text.splitlines(keepends=True) or [""]
            at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
            change = rng.randrange(3)
            if change == 0:
                lines.insert(to, lines[at])
            elif change == 1:
                lines[at], lines[to] = lines[to], lines[at]
            else:
                del lines[at]
            text = "".join(lines)
        else:
            a = rng.randrange(len(text) + 1)
            b = min(len(text), a + rng.choice([0, 0, 1, 3, 20]))
            text = text[:a] + rng.choice(WORDS) + text[b:]
    return text.encode("utf-8", "surrogateescape")


# -- logs, from the inside -----------------------------------------------------------------


def _payload(data, rng):
    kind = rng.randrange(5)
    if kind == 0:
        return b""
    if kind == 1:
        return data[: rng.randrange(len(data) + 1)]
    changed = bytearray(data)
    if kind == 2 and len(changed) >= 16:  # a value of a JointState, most likely
        at = 4 * rng.randrange(1, len(changed) // 4 - 1)
        value = rng.choice([float("nan"), float("inf"), 1e308, -1e308, 1e-320, 0.0])
        struct.pack_into("<d", changed, at, value)
    elif kind == 3 and len(changed) >= 12:  # its stamp
        seconds = rng.choice([-(2**31), -1, 0, 2**31 - 1, 10**9 * 2])
        struct.pack_into("<iI", changed, 4, seconds, rng.choice([0, 999_999_999, 2**32 - 1]))
    elif changed:
        _flip_bits(changed, rng)
    return bytes(changed)


class _Remake:
    """Writes the messages of a log again, some of them with faults."""

    def __init__(self, writer, rng, faults):
        self.writer, self.rng, self.faults = writer, rng, faults
        self.schemas = {}
        self.channels = {}
        self.jump = rng.choice(JUMPS)

    def add(self, number, schema, channel, message, *, hit):
        """Add one message; ``hit`` is whether it gets the faults of single messages."""
        rng, faults = self.rng, self.faults if hit else self.faults & {"time"}
        if schema.id not in self.schemas:
            self._add_schema(schema)
        if channel.id not in self.channels or "channel" in faults:
            self._add_channel(channel, schema.id, astray="channel" in faults)
        if "few" in faults:
            return
        payload = _payload(message.data, rng) if "payload" in faults else message.data
        log_ns = message.log_time
        if "time" in faults:
            log_ns = rng.choice([*HUGE, log_ns - self.jump]) if hit else log_ns
            log_ns += self.jump if number > 40 else 0
        if "order" in faults:
            log_ns = max(0, log_ns - rng.choice([1, 10**8, 10**10]))
        times = log_ns % 2**64, message.publish_time % 2**64
        of = self.channels[channel.id]
        self.writer.add_message(of, times[0], payload, times[1], message.sequence)

    def _add_schema(self, schema):
        name, text = schema.name, schema.data
        if "schema" in self.faults:
            text = mutate_text(text, self.rng)
            if self.rng.random() < 0.2:
                name = mutate_text(name.encode(), self.rng).decode("utf-8", "replace")[:200]
        self.schemas[schema.id] = self.writer.register_schema(name, schema.encoding, text)

    def _add_channel(self, channel, schema_id, *, astray):
        topic, facts = channel.topic, dict(channel.metadata)
        if "names" in self.faults:
            topic = mutate_text(topic.encode(), self.rng).decode("utf-8", "replace")[:300]
            facts = {k: self.rng.choice([v, *WORDS[:25]]) for k, v in facts.items()}
        used = self.rng.choice([*self.schemas.values(), 0]) if astray else self.schemas[schema_id]
        description = (topic, channel.message_encoding, used, facts)
        self.channels[channel.id] = self.writer.register_channel(*description)


def remake_log(data, rng, scratch):
    """A log with faults inside its messages and right checksums around them.

    Args:
        data: An MCAP file.
        rng: Chooses the faults.
        scratch: A file to write to.

    Returns:
        The bytes of the new file.
    """
    source, target = scratch.with_suffix(".old"), scratch.with_suffix(".new")
    source.write_bytes(data)
    every = rng.choice([1, 3, 20, 100, 1000])
    kinds = ["time", "payload", "schema", "names", "channel", "few", "order"]
    faults = set(rng.sample(kinds, rng.choice([1, 1, 2, 3])))
    options = {
        "compression": rng.choice(list(CompressionType)),
        "chunk_size": rng.choice([200, 2000, 1 << 20]),
        "use_chunking": rng.random() < 0.9,
        "index_types": rng.choice([IndexType.ALL, IndexType.ALL, IndexType.NONE]),
    }
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, **options)
        writer.start(rng.choice(["ros2", "ros2", ""]), "another make")
        remake = _Remake(writer, rng, faults)
        for number, (schema, channel, message) in enumerate(reader.iter_messages()):
            remake.add(number, schema, channel, message, hit=rng.randrange(every) == 0)
        with contextlib.suppress(McapError):
            for attachment in reader.iter_metadata():
                facts = dict(attachment.metadata)
                if "names" in faults:
                    facts = {k: rng.choice([v, *WORDS, *NUMBERS]) for k, v in facts.items()}
                writer.add_metadata(attachment.name, facts)
            for attachment in reader.iter_attachments():
                content = attachment.data
                if "names" in faults and rng.random() < 0.5:
                    content = mutate_text(content, rng)
                writer.add_attachment(
                    0,
                    attachment.create_time,
                    attachment.name,
                    attachment.media_type,
                    content,
                )
        writer.finish()
    return target.read_bytes()


# -- databases -----------------------------------------------------------------------------


def remake_database(data, rng, scratch):
    """Return an SQLite file with faults in rows, columns or the layout."""
    path = scratch.with_suffix(".db")
    path.write_bytes(data)
    with contextlib.closing(sqlite3.connect(path)) as base:
        (table,) = base.execute("select name from sqlite_master where type='table'").fetchone()
        columns = [row[1] for row in base.execute(f'pragma table_info("{table}")')]
        values = [None, "x", b"\xff\x00", -1, 0, 2**63 - 1, -(2**63), 1e308, float("inf"), 2**40]
        for _ in range(rng.choice([1, 2, 4])):
            column, row = rng.choice(columns), rng.randrange(1, 60)
            with contextlib.suppress(sqlite3.DatabaseError):
                kind = rng.random()
                if kind < 0.8:
                    change = f'update "{table}" set "{column}"=? where rowid=?'
                    base.execute(change, (rng.choice(values), row))
                elif kind < 0.9:
                    base.execute(f'alter table "{table}" drop column "{column}"')
                else:
                    base.execute(f'delete from "{table}" where rowid>?', (row % 3,))
        base.commit()
    return path.read_bytes()
