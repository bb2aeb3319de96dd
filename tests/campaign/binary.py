"""Binary CAN logs and databases: whole ones, and faults in their structure."""

import contextlib
import re
import sqlite3
import struct
import zlib

from can.io.blf import LOG_CONTAINER, OBJ_HEADER_BASE_STRUCT

from support.written_frames import log_messages

from .base import Base, can_messages, write_texts
from .mutate import HUGE, mutate_bytes, remake_database
from .packed import MIB, deflated_zeros, one_of

SUFFIXES = ("blf", "db", "mf4")
_CONTAINER_HEAD = 16
"""Bytes between the base header of a BLF container and its data."""

COMPUTED = (
    "zeroblob(1000000)", "zeroblob(900000000)", "hex(zeroblob(400000))", "randomblob(timestamp)",
    "printf('%.*c', 2000000, 'x')", "hex(hex(hex(hex(timestamp))))", "NULL", "x''",
)  # fmt: skip
"""Expressions of a generated column."""


def binary_bases(folder, database):
    """Write traces to a new folder; ``database`` is the content of a .db3 file."""
    folder.mkdir()
    texts = write_texts(folder)
    bases = []
    for kind in SUFFIXES:
        path = log_messages(folder / f"binary.{kind}", can_messages())
        files = {path.name: path.read_bytes(), **texts}
        bases.append(Base("binary trace", path.name, files, (path.name,)))
    return [*bases, Base("database", "lone.db3", {"lone.db3": database}, ("lone.db3",))]


# -- MF4 -----------------------------------------------------------------------------------


def _odd_blocks(data, rng):
    """Change lengths, links and counts of blocks; have blocks point at each other."""
    changed = bytearray(data)
    blocks = [match.start() for match in re.finditer(rb"##[A-Z]{2}", data)]
    if not blocks:
        return data
    for _ in range(rng.choice([1, 1, 2, 5])):
        at = rng.choice(blocks) + 8 * rng.choice([1, 2, 3, 4, 5, 6, 8, 10, 12, 14])
        if at + 8 > len(changed):
            continue
        value = rng.choice([*HUGE, rng.choice(blocks), rng.choice(blocks), 0, 1, 24])
        struct.pack_into("<Q", changed, at, value & (1 << 64) - 1)
    return bytes(changed)


def _odd_kind(data, rng):
    """Put a block's kind in place of another's."""
    kinds = re.findall(rb"##[A-Z]{2}", data)
    if not kinds:
        return data
    return data.replace(rng.choice(kinds), rng.choice(kinds), rng.choice([1, -1]))


# -- BLF -----------------------------------------------------------------------------------


def _containers(data):
    """Yield start and end of the objects of a BLF file that are containers."""
    at = 144
    while at + OBJ_HEADER_BASE_STRUCT.size <= len(data):
        signature, _, _, size, kind = OBJ_HEADER_BASE_STRUCT.unpack_from(data, at)
        if signature != b"LOBJ" or size < OBJ_HEADER_BASE_STRUCT.size:
            return
        if kind == LOG_CONTAINER:
            yield at, at + size
        at += size + size % 4


def _odd_container(data, rng):
    """Pack a container again with faults inside, or with zeros behind them."""
    places = list(_containers(data))
    if not places:
        return data
    start, end = rng.choice(places)
    begin = start + OBJ_HEADER_BASE_STRUCT.size + _CONTAINER_HEAD
    try:
        inside = zlib.decompress(data[begin:end])
    except zlib.error:
        return data
    packer = zlib.compressobj(9)
    packed = packer.compress(mutate_bytes(inside, rng)) + packer.flush(zlib.Z_SYNC_FLUSH)
    if rng.random() < 0.2:
        packed += deflated_zeros(rng.choice([60, 1000]) * MIB)
    packed += packer.flush()
    head = bytearray(data[start:begin])
    size = len(head) + len(packed)
    struct.pack_into("<I", head, 8, size)
    return data[:start] + bytes(head) + packed + bytes(size % 4) + data[end + (end - start) % 4 :]


# -- SQLite --------------------------------------------------------------------------------


def computed(data, rng):
    """Return a database one of whose columns of messages is computed."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(":memory:")) as db:
        db.deserialize(data)
        names = [row[1] for row in db.execute("PRAGMA table_info(messages)")]
        chosen = rng.choice(names)
        column = rng.choice([*(f"AS ({rule})" for rule in COMPUTED), "AS (zeroblob(9)) STORED"])
        columns = [f"{name} {column}" if name == chosen else name for name in names]
        kept = ", ".join(name for name in names if name != chosen)
        db.executescript(
            "ALTER TABLE messages RENAME TO old; "
            f"CREATE TABLE messages({', '.join(columns)}); "
            f"INSERT INTO messages({kept}) SELECT {kept} FROM old; DROP TABLE old;"
        )
        return db.serialize()
    return data


def _odd_program(data, rng):
    """Add what is computed when pages are checked or rows are found."""
    change = rng.choice([
        "CREATE INDEX odd ON messages(hex(zeroblob(5000)))",
        "CREATE INDEX odd ON messages(rowid) WHERE hex(zeroblob(5000)) > 'x'",
        "ALTER TABLE messages ADD COLUMN more CHECK (length(hex(zeroblob(500000))) > 0)",
        "ALTER TABLE messages ADD COLUMN more DEFAULT (hex(zeroblob(1000)))",
        ("CREATE TABLE wide AS SELECT * FROM messages; DROP TABLE messages; "
        "CREATE VIEW messages AS SELECT * FROM wide, wide b, wide c, wide d"),
    ])  # fmt: skip
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(":memory:")) as db:
        db.deserialize(data)
        db.executescript(change)
        return db.serialize()
    return data


# -- MATLAB --------------------------------------------------------------------------------


def odd_types(data, rng):
    """Change types and sizes of the elements of a .mat file that is not compressed."""
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3])):
        at = 128 + 4 * rng.randrange(max(1, (len(changed) - 132) // 4))
        if rng.random() < 0.6:
            at = 128 + 4 * rng.randrange(20)
        if at + 4 <= len(changed):
            value = rng.choice([*range(20), *HUGE])
            struct.pack_into("<I", changed, at, value & 0xFFFF_FFFF)
    return bytes(changed)


def structure(scratch, others):
    """Return suffix to a function that makes a file again, with a fault."""
    return others | {
        ".mf4": one_of(_odd_blocks, _odd_blocks, _odd_kind),
        ".blf": one_of(_odd_container),
        ".db": one_of(
            lambda data, rng: remake_database(data, rng, scratch), computed, _odd_program
        ),
        ".db3": one_of(others[".db3"], others[".db3"], computed, _odd_program),
        ".mat": one_of(others[".mat"], odd_types),
    }
