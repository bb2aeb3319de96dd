"""Faults in the structure of JSON, tables as text and streams of packets."""

import json

from undulog.capture.robot.serial_servos import dynamixel_packet, feetech_packet

from .mutate import HUGE, NUMBERS, WORDS
from .packed import PACKED, one_of

# -- JSON ----------------------------------------------------------------------------------


def _places(value, places):
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in list(items):
        places.append((value, key))
        if isinstance(inner, dict | list):
            _places(inner, places)
    return places


def _odd_json(data, rng):
    """Put an odd value in place of one, or an odd name."""
    try:
        tree = json.loads(data)
    except ValueError:
        return data
    if not isinstance(tree, dict | list) or not tree:
        return data
    owner, key = rng.choice(_places(tree, []))
    odd = [None, True, -1, 0, 1.5, 10**400, [], {}, "", *HUGE, [10**9], [[[]]], ["a"] * 100_000]
    odd += [rng.choice(WORDS), ["\x1b[2J", "a"], ["a", "a", "a"], [rng.choice(WORDS)] * 3]
    kind = rng.random()
    if kind < 0.7:
        owner[key] = rng.choice(odd)
    elif kind < 0.85 and isinstance(owner, dict):
        owner[rng.choice(WORDS[:25])] = owner.pop(key)
    else:
        del owner[key]
    text = json.dumps(tree)
    if rng.random() < 0.2:
        place = rng.choice([k for k, c in enumerate(text) if c == ":"] or [0])
        raw = ["NaN", "Infinity", "1e999", "[" * 100_000, '{"a":' * 100_000, "9" * 5000]
        text = text[: place + 1] + rng.choice(raw) + text[place + 1 :]
    return text.encode("utf-8", "surrogateescape")


# -- tables as text ------------------------------------------------------------------------


def _rows(data):
    text = data.decode("utf-8", "replace")
    mark = next((mark for mark in ";\t, " if mark in text[:200]), ",")
    return mark, [line.split(mark) for line in text.splitlines()] or [[""]]


def _joined(mark, rows):
    return "\n".join(mark.join(row) for row in rows).encode("utf-8", "surrogateescape")


VECTORS = [
    "[]", "[0.1]", '"[0.1, 0.2"', '"[0.1, nan, 1e999]"', "[" * 3000, "(0.1 0.2 0.3)", '"[[1],[2]]"',
    '"[null, true, 3]"', '"{}"', "[" + "1 " * 10_000 + "]",
]  # fmt: skip


def _odd_cells(data, rng):
    mark, rows = _rows(data)
    for _ in range(rng.choice([1, 3, 50])):
        row = rng.choice(rows)
        row[rng.randrange(len(row))] = rng.choice([*NUMBERS, *WORDS[:25], *VECTORS])
    return _joined(mark, rows)


def _odd_table_column(data, rng):
    mark, rows = _rows(data)
    k = rng.randrange(len(rows[0]))
    value = rng.choice([*NUMBERS, "", "0", *WORDS[:25], *VECTORS])
    for row in rows[rng.choice([0, 1, 20]) :]:
        if k < len(row):
            row[k] = value
    return _joined(mark, rows)


def _odd_shape(data, rng):
    mark, rows = _rows(data)
    kind = rng.randrange(6)
    if kind == 0:
        rows = [row * rng.choice([2, 100, 1500]) for row in rows]
    elif kind == 1:
        rows = [row[: rng.randrange(len(row) + 1)] if k > 30 else row for k, row in enumerate(rows)]
    elif kind == 2:
        rows = rows[: rng.choice([0, 1, 2])]
    elif kind == 3:
        rows = rows[:1] + rows[1:] * rng.choice([5, 200])
    elif kind == 4:
        rows = [["#" * rng.choice([1, 70_000])]] * rng.choice([1, 30]) + rows
    else:
        rows = [*rows, ["x" * 5_000_000]]
    return _joined(mark, rows)


def _otherwise_encoded(data, rng):
    text = data.decode("utf-8", "replace")
    changed = [
        text.encode("utf-16"),
        text.replace("\n", "\r").encode(),
        text.replace(".", ",").encode(),
        text.replace("\n", "\n\0").encode(),
        b"\xef\xbb\xbf" * 2 + data,
        text.replace("\n", '\n"', 1).encode(),
        text.replace("\n", "\n\n").encode(),
    ]
    return rng.choice(changed)


def _long(data, rng):
    """A row a joint and a time, of many joints that are seldom there."""
    joints, rows = rng.choice([(3, 3000), (500, 20_000), (3000, 60_000)])
    name = rng.choice(["j", "\x1b[2Jj", "=1+1", "a" * 300 if joints < 1000 else "k"])
    step = rng.choice([0.0, 0.01])
    cells = (f"{step * k:.2f},{name}{k % joints},{k % 7 / 7:.3f}" for k in range(rows))
    return "\n".join(["time,joint,angle", *cells]).encode()


# -- packets -------------------------------------------------------------------------------

PACKETS = {"feetech": feetech_packet, "dynamixel2": dynamixel_packet}


def _protocol(data):
    return "dynamixel2" if b"\xff\xff\xfd\x00" in data else "feetech"


def _odd_packets(data, rng):
    """Put packets with right checksums and any content among the others."""
    pack = PACKETS[_protocol(data)]
    out = bytearray(data)
    for _ in range(rng.choice([1, 20, 200])):
        size = rng.choice([0, 1, 2, 4, 8, 60, 240])
        servo, instruction = rng.choice([0, 1, 2, 0xFD, 0xFE]), rng.randrange(256)
        start = bytes(rng.choice([42, 56, 116, 132, 0, 255]) for _ in range(min(size, 4)))
        packet = pack(servo, instruction, (start + rng.randbytes(size))[:size])
        at = rng.randrange(len(out) + 1)
        out[at:at] = packet
    return bytes(out)


def nested_packets(depth):
    """Return Feetech packets inside each other, each with a right checksum."""
    packet = feetech_packet(1, 2)
    for _ in range(depth):
        packet = feetech_packet(1, 3, packet)
    return packet


def _nested(data, rng):
    return data + nested_packets(rng.choice([5, 20, 40])) * rng.choice([1, 50])


def _noise(data, rng):
    heads = [b"\xff", b"\xff\xff", b"\xff\xff\xfd\x00\x01\xff\x0f", b"\xff\xff\x01\xff", b"\0"]
    noise = rng.choice(heads) * rng.choice([10, 3000, 30_000])
    return rng.choice([noise, noise + data, data + noise, data + rng.randbytes(20_000)])


def _doubled(data, rng):
    return data * rng.choice([2, 20])


_OF_TEXT = one_of(_odd_cells, _odd_cells, _odd_table_column, _odd_shape, _otherwise_encoded, _long)
STRUCTURE = {
    **PACKED,
    ".json": _odd_json,
    ".jsonl": _odd_json,
    ".csv": _OF_TEXT,
    ".txt": _OF_TEXT,
    ".bin": one_of(_odd_packets, _odd_packets, _nested, _noise, _doubled),
}  # fmt: skip
"""Suffix to a function that makes its file again from its bytes, with a fault."""
