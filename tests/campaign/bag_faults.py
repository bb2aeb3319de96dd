"""Faults in the structure of recordings of ROS: metadata, databases, records and compression."""

import bz2
import contextlib
import io
import re
import sqlite3
import struct
from functools import cache

import lz4.frame
import zstandard
from hostile_logs import lz4_zeros, zeros
from mcap.reader import make_reader
from mcap.writer import Writer

from .mutate import HUGE, NUMBERS, WORDS, mutate_bytes, mutate_text
from .packed import MIB, one_of

# -- metadata.yaml -------------------------------------------------------------------------

_ODD_VALUES = [
    "-1", "18446744073709551616", "9" * 5000, "1e999", ".nan", "null", "true", "~", "[]", "{}",
    '"\\e[2J"', '"\\0"', "'x'", "/etc/passwd", "../../up.mcap", "..", "/dev/zero", "*a", "&a [*a]",
    "!!binary AAAA", "!!python/object/apply:os.system [touch new]", "2001-01-01", "<<", "zstd",
    "message", "file", "FILE", "lz4", "mcap", "sqlite3", "[[1], {a: 2}]", "? [a]", "|\n  x", "'",
]  # fmt: skip


def _odd_value(data, rng):
    """Put odd values in place of some."""
    text = data.decode("utf-8", "replace")
    for _ in range(rng.choice([1, 1, 2, 5])):
        places = list(re.finditer(r"(?m)(?<=: )\S.*$|(?<=- )\S+$", text))
        if not places:
            break
        place = rng.choice(places)
        value = rng.choice([*_ODD_VALUES, *NUMBERS, *map(str, HUGE)])
        text = text[: place.start()] + value + text[place.end() :]
    return text.encode("utf-8", "surrogateescape")


def _laughs(depth, width, kind):
    """Yield lines in which each node holds the one before several times."""
    yield "a0: &a0 " + ("{x: 1}" if kind == "merge" else "[x, x]")
    for k in range(depth):
        inner = ", ".join([f"*a{k}"] * width)
        yield f"a{k + 1}: &a{k + 1} " + ("{<<: [%s]}" if kind == "merge" else "[%s]") % inner


def _bomb(data, rng):
    """Aliases of aliases, merges of merges, depth, or length; used by a field, or by none."""
    text = data.decode("utf-8", "replace")
    depth = rng.choice([9, 30, 300])
    kind = rng.choice(["list", "merge"])
    lines = "\n".join(_laughs(depth, rng.choice([2, 9]), kind))
    fields = ["compression_format", "storage_identifier", "relative_file_paths", "custom_data"]
    owner = rng.choice([*fields, "version", "topics_with_message_count", "message_count"])
    used = f"{lines}\n" + re.sub(rf"(?m)^  {owner}:.*(\n  - .*)*", f"  {owner}: *a{depth}", text)
    big = rng.choice(["[", "{a: ", "- ", "? ", "&a "]) * rng.choice([500, 100_000])
    rows = rng.choice(["- a\n", "k: [1, 2, {a: b}]\n", "# x\n", "\n"]) * rng.choice([300, 400_000])
    return rng.choice([used, used, text + big, "custom:\n" + rows + text]).encode()


def _odd_files(data, rng):
    """Name other files, or the same ones more than once."""
    text = data.decode("utf-8", "replace")
    match = re.search(r"(?m)^  relative_file_paths:\n((?:  - .*\n)+)", text)
    if match is None:
        return data
    rows = match[1].splitlines(keepends=True)
    others = ["/etc/passwd", "../x.mcap", "metadata.yaml", ".", "''", "/dev/zero", "a\\0b", "\\e"]
    more = [
        rows * rng.choice([2, 50, 3000]),
        [*rows, f"  - {rng.choice(others)}\n"],
        [f"  - '../../../{rows[0].strip(' -')[:60]}'\n".replace("\n'", "'")],
        [f"  - {rng.choice(others)}\n"],
        rows[::-1],
        rows[1:],
        [],
    ]
    return (text[: match.start(1)] + "".join(rng.choice(more)) + text[match.end(1) :]).encode()


# -- databases -----------------------------------------------------------------------------

_DATA = [b"", b"\0", b"\0\1\0\0", b"\0\0\0\0" + bytes(60), b"\0\1\0\0" + b"\xff" * 80, "text", 7]
_QOS = ["[" * 3000, "- {history: 1}", "a: &a [*a]", "\n".join(_laughs(30, 9, "merge")), "'", "\x1b"]
_ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT "
_SCHEMAS = [
    # A table whose values are computed, or a view in its place, without end.
    ("ALTER TABLE messages RENAME TO old; CREATE TABLE messages(id INTEGER PRIMARY KEY, "
    "topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
    "data BLOB GENERATED ALWAYS AS (zeroblob(900000000))); "
    "INSERT INTO messages SELECT id, topic_id, timestamp FROM old"),
    (f"DROP TABLE message_definitions; CREATE VIEW message_definitions AS {_ENDLESS}"
    "x id, 'a' || x topic_type, 'ros2msg' encoding, 'b' encoded_message_definition, "
    "'' type_description_hash FROM c"),
    ("CREATE TABLE m2 AS SELECT * FROM messages; DROP TABLE messages; "
    f"CREATE VIEW messages AS {_ENDLESS}x id, 1 topic_id, x timestamp, '' data FROM c"),
    "DROP TABLE schema", "DROP TABLE message_definitions", "DELETE FROM topics",
    "DELETE FROM messages", "UPDATE schema SET schema_version = 2", "DROP INDEX timestamp_idx",
    "UPDATE messages SET topic_id = topic_id + 1", "UPDATE messages SET topic_id = 1",
    "UPDATE messages SET timestamp = -timestamp", "UPDATE messages SET timestamp = id",
    "UPDATE message_definitions SET encoding = 'ros2idl'",
    "UPDATE message_definitions SET encoded_message_definition = topic_type",
    ("INSERT INTO topics SELECT id + 100, name, type, serialization_format, offered_qos_profiles, "
    "type_description_hash FROM topics"),
]  # fmt: skip
_VALUES = [
    "UPDATE topics SET type = (SELECT type FROM topics ORDER BY id DESC LIMIT 1)",
    "UPDATE topics SET name = ? WHERE id = 1", "UPDATE topics SET type = ? WHERE id = 1",
    "UPDATE message_definitions SET encoded_message_definition = ? WHERE id < 3",
    "UPDATE messages SET timestamp = ? WHERE id % 7 = 0",
]  # fmt: skip


def _database(data):
    base = sqlite3.connect(":memory:")
    base.deserialize(data)
    return contextlib.closing(base)


def _odd_database(data, rng):
    with contextlib.suppress(sqlite3.Error), _database(data) as base:
        kind = rng.random()
        if kind < 0.4:
            base.executescript(rng.choice(_SCHEMAS))
        elif kind < 0.6:
            change = rng.choice(_VALUES)
            value = rng.choice([*WORDS, *NUMBERS, -(2**63), 2**63 - 1, 1e308, None])
            base.execute(change, (value,) if "?" in change else ())
        elif kind < 0.7:
            base.execute("UPDATE topics SET offered_qos_profiles = ?", (rng.choice(_QOS),))
        else:
            every = rng.choice([1, 3, 40])
            value = rng.choice([*_DATA, zstd_bomb(rng)])
            base.execute("UPDATE messages SET data = ? WHERE id % ? = 0", (value, every))
        base.commit()
        return base.serialize()
    return data


def _odd_pages(data, rng):
    """Cut pages, put one in place of another, or set numbers in the head of one."""
    size = int.from_bytes(data[16:18], "big") or 4096
    pages = [data[at : at + size] for at in range(0, len(data), size)]
    for _ in range(rng.choice([1, 3])):
        a, b = rng.randrange(len(pages)), rng.randrange(len(pages))
        kind = rng.randrange(4)
        if kind == 0:
            pages[a] = pages[b]
        elif kind == 1:
            del pages[a:]
        elif kind == 2:
            pages[a] = pages[a][: rng.randrange(size)]
        else:
            page = bytearray(pages[a])
            at = rng.choice([0, 1, 3, 5, 7, 8, 10, 12, 18, 28, 100, 105])
            page[at : at + 2] = struct.pack(">H", rng.choice(HUGE) & 0xFFFF)
            pages[a] = bytes(page)
        if not pages:
            break
    return b"".join(pages)


# -- compression ---------------------------------------------------------------------------


_zeros = cache(zeros)


def zstd_bomb(rng):
    """Return zeros in a frame, which may state another size; or many frames."""
    size = rng.choice([1, 64, 700, 3000]) * MIB
    data = _zeros(size, stated=rng.random() < 0.5)
    return data * rng.choice([1, 1, 50]) if size <= 64 * MIB else data


def _odd_frame(data, rng):
    """Change what is inside a compressed file, or have it expand."""
    kind = rng.random()
    if kind < 0.25:
        return rng.choice([bomb := zstd_bomb(rng), data + bomb, bomb + data])
    with contextlib.suppress(zstandard.ZstdError):
        inside = zstandard.ZstdDecompressor().decompressobj().decompress(data)
        change = _odd_database if inside.startswith(b"SQLite") and kind < 0.7 else mutate_bytes
        return zstandard.compress(change(inside, rng))
    return data


def _odd_messages(data, rng):
    """Write an MCAP again, with other contents of some messages."""
    out, every = io.BytesIO(), rng.choice([1, 3, 40])
    value = rng.choice([*_DATA[:5], zstd_bomb(rng)])
    writer = Writer(out)
    writer.start("ros2", "")
    channels = {}
    for number, (schema, way, message) in enumerate(make_reader(io.BytesIO(data)).iter_messages()):
        if way.topic not in channels:
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            facts = dict(way.metadata) | {"offered_qos_profiles": rng.choice(["", *_QOS])}
            channels[way.topic] = writer.register_channel(way.topic, "cdr", kind, facts)
        content = value if number % every == 0 else message.data
        writer.add_message(channels[way.topic], message.log_time, content, message.publish_time)
    writer.finish()
    return out.getvalue()


def _try_messages(data, rng):
    try:
        return _odd_messages(data, rng)
    except Exception:  # noqa: BLE001 - it was damaged before, which its reader reports in many ways
        return data


# -- ROS 1 ---------------------------------------------------------------------------------

_MAGIC = b"#ROSBAG V2.0\n"
_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 3, 4, 5, 6, 7


def _records(data):
    """Return the records of a bag: fields of the header, and content."""
    at, records = len(_MAGIC), []
    while at + 4 <= len(data):
        (size,) = struct.unpack_from("<I", data, at)
        head, fields, inner = data[at + 4 : at + 4 + size], {}, 0
        while inner < size:
            (length,) = struct.unpack_from("<I", head, inner)
            name, _, value = head[inner + 4 : inner + 4 + length].partition(b"=")
            fields[name], inner = value, inner + 4 + length
        at += 4 + size
        (size,) = struct.unpack_from("<I", data, at)
        records.append([fields, data[at + 4 : at + 4 + size], at])
        at += 4 + size
    return records


def _packed(fields):
    parts = (name + b"=" + value for name, value in fields.items())
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def _bag(records):
    """Return a bag of records, with the places of chunks and index as they are now."""
    out, moved, before = bytearray(_MAGIC), {}, len(_MAGIC)
    index_at = None
    for fields, content, end in records:
        op = fields.get(b"op", b"\0")[0]
        moved.setdefault(before, len(out))
        before = end + 4 + len(content) if end is not None else before
        if op in {_CONNECTION, _CHUNK_INFO} and index_at is None:
            index_at = len(out)
        if op == _CHUNK_INFO and len(fields.get(b"chunk_pos", b"")) == 8:
            (place,) = struct.unpack("<Q", fields[b"chunk_pos"])
            fields[b"chunk_pos"] = struct.pack("<Q", moved.get(place, place))
        for part in (_packed(fields), content):
            out += struct.pack("<I", len(part)) + part
    return bytes(out), index_at


def _rebuilt(records):
    data, index_at = _bag(records)
    fields = records[0][0]
    if index_at is not None and b"index_pos" in fields:
        fields[b"index_pos"] = struct.pack("<Q", index_at)
        data, _ = _bag([[dict(fields), *records[0][1:]], *records[1:]])
    return data


def _of(records, op):
    return [record for record in records if record[0].get(b"op", b"\0")[0] == op]


@cache
def bz2_zeros(mib):
    return bz2.compress(bytes(MIB)) * mib  # streams one after the other are read as one


def _bomb_chunk(data, rng):
    """A chunk expands far beyond what it declares, or honestly to hundreds of MiB."""
    records = _records(data)
    fields, inside, _ = chunk = rng.choice(_of(records, _CHUNK))
    mib = rng.choice([10, 300, 3000])
    kind = rng.choice(["bz2", "lz4"])
    chunk[1] = bz2_zeros(mib) if kind == "bz2" else lz4_zeros(mib * MIB)
    plain = {b"none": bytes, b"bz2": bz2.decompress, b"lz4": lz4.frame.decompress}
    if rng.random() < 0.5:  # its own messages, then zeros
        payload = plain[fields[b"compression"]](inside)
        pack = bz2.compress if kind == "bz2" else lz4.frame.compress
        chunk[1] = pack(payload + bytes(min(mib, 300) * MIB))
    declared = rng.choice([len(inside), mib * MIB, 0, 2**32 - 1])
    fields[b"compression"], fields[b"size"] = kind.encode(), struct.pack("<I", declared)
    return _rebuilt(records)


def _lying_record(data, rng):
    """A field or a length of any record is another number."""
    records = _records(data)
    for _ in range(rng.choice([1, 1, 3])):
        fields, content, _ = record = rng.choice(records)
        numbers = [name for name, value in fields.items() if len(value) in {4, 8}]
        kind = rng.random()
        if kind < 0.4 and numbers:
            name = rng.choice(numbers)
            number = rng.choice([*HUGE, *range(4)]) & ((1 << 8 * len(fields[name])) - 1)
            fields[name] = number.to_bytes(len(fields[name]), "little")
        elif kind < 0.6:
            name = rng.choice(list(fields))
            fields[name] = mutate_text(fields[name], rng)
        elif kind < 0.7:
            del fields[rng.choice(list(fields))]
        elif len(content) >= 16:
            record[1] = mutate_bytes(content, rng)
    return _rebuilt(records)


def _repeated(data, rng):
    """Indexes of one chunk, or one entry of an index, many times."""
    records = _records(data)
    infos = _of(records, _CHUNK_INFO)
    count = rng.choice([2, 100, 5000])
    if rng.random() < 0.5:
        at = records.index(infos[0])
        records[at:at] = [[dict(infos[0][0]), infos[0][1], None] for _ in range(count)]
        total = struct.pack("<I", len(infos) + count)
        records[0][0][b"chunk_count"] = total
    else:
        fields, content, _ = index = rng.choice(_of(records, _INDEX))
        index[1] = content[:12] * (count * 10) + content
        fields[b"count"] = struct.pack("<I", len(index[1]) // 12)
    return _rebuilt(records)


def _odd_connection(data, rng):
    """A connection has another type, another definition, or another number."""
    records = _records(data)
    connections = _of(records, _CONNECTION)
    connection, other = rng.choice(connections), rng.choice(connections)
    kind = rng.randrange(3)
    if kind == 0:
        connection[1] = other[1]
    elif kind == 1:
        connection[0][b"conn"] = other[0][b"conn"]
    else:
        inside = mutate_text(connection[1], rng)
        name = b"message_definition="
        texts = [b"", b"float64[] a\n" * 20_000, b"A a\n" + b"=" * 80 + b"\nMSG: x/A\nx/A a\n"]
        texts += [b"uint8[4000000000] a\n", b"float64[10000000] a\n", b"\x1b[2J a\n"]
        definition = name + rng.choice(texts)
        inside += struct.pack("<I", len(definition)) + definition
        connection[1] = inside
    return _rebuilt(records)


def _of_records(*faults):
    def remake(data, rng):
        with contextlib.suppress(struct.error, IndexError, KeyError, EOFError):  # cut before
            return rng.choice(faults)(data, rng)
        return data

    return remake


# -- folders -------------------------------------------------------------------------------


def mutate_folder(files, rng):
    """Remove a file of a bag, name it otherwise, or put something else in its place."""
    names = [name for name in files if not name.endswith(".yaml")]
    name, kind = rng.choice(names), rng.randrange(6)
    folder, _, base_name = name.rpartition("/")
    if kind == 0:
        del files[name]
    elif kind == 1:
        files[f"{folder}/copy-of-{base_name}"] = files[name]
    elif kind == 2:
        files[name] = rng.choice([b"", b"\0" * 100, files[rng.choice(list(files))]])
    elif kind == 3:
        files[f"{folder}/{rng.choice(['x.mcap', 'x.db3', 'a b.mcap', 'x.bag'])}"] = files.pop(name)
    elif kind == 4:
        files[f"{name}/inner"] = files.pop(name)
    else:
        del files[f"{folder}/metadata.yaml"]


BAGS = {
    ".yaml": one_of(_odd_value, _odd_value, _odd_files, _bomb, mutate_text),
    ".db3": one_of(_odd_database, _odd_database, _odd_pages),
    ".zstd": _odd_frame,
    ".mcap": _try_messages,
    ".bag": _of_records(_bomb_chunk, _lying_record, _lying_record, _repeated, _odd_connection),
}
"""Suffix to a function that makes its file again from its bytes, with a fault."""
