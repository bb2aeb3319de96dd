"""Logs written by hand to take memory or time, or to break a reader's assumptions.

The records are packed byte by byte, since no writer would make them.
"""

import random
import shlex
import struct
from functools import partial
from pathlib import Path

import zstandard
from hostile_logs import MAGIC, joint_state, lz4_zeros, record, text, zeros

from undulog.capture.log.messages.definitions import schema_text

from .base import EPOCH_NS, PERIOD_NS, ROBOT, SCENARIO, write_files
from .case import Result, run_command
from .fuzz import check_output

JOINT_STATE = "sensor_msgs/msg/JointState"
GIB = 1 << 30


HEADER = MAGIC + record(1, text("ros2") + text("hand"))
END = record(15, struct.pack("<I", 0)) + record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC


def schema(number=1, name=JOINT_STATE, data=None):
    definition = schema_text(name) if data is None else data
    return record(3, struct.pack("<H", number) + text(name) + text("ros2msg") + text(definition))


def channel(number, topic, of=1):
    head = struct.pack("<HH", number, of)
    return record(4, head + text(topic) + text("cdr") + struct.pack("<I", 0))


def message(number, log_ns, payload, sequence=0):
    return record(5, struct.pack("<HIQQ", number, sequence, log_ns, log_ns) + payload)


def chunk(inside, *, size=None, packed=None, kind="zstd"):
    data = zstandard.compress(inside) if packed is None else packed
    head = struct.pack("<QQQI", EPOCH_NS, EPOCH_NS, len(inside) if size is None else size, 0)
    return record(6, head + text(kind) + struct.pack("<Q", len(data)) + data)


PAIR = schema() + channel(1, "/joint_commands") + channel(2, "/joint_states")


def sines(ticks, jump_ns=0):
    """Yield commands and states; the clock jumps once, in the middle."""
    rng = random.Random(1)
    for tick in range(ticks):
        t_ns = EPOCH_NS + tick * PERIOD_NS + (jump_ns if tick >= ticks // 2 else 0)
        for number in (1, 2):
            values = [0.3 * ((tick * 7 + 3 * k) % 50 / 25 - 1) + rng.gauss(0, 1e-3) for k in (0, 1)]
            yield message(number, t_ns % 2**64, joint_state(t_ns % 2**62, ["a", "b"], values), tick)


# -- the logs ------------------------------------------------------------------------------


def bomb(*, size, declared, stated=True, cut=0):
    packed = zeros(size, stated=stated)
    whole = HEADER + PAIR + chunk(b"", size=declared, packed=packed) + chunk(b"".join(sines(20)))
    return whole[: len(HEADER + PAIR) + len(packed) - cut] if cut else whole + END


def lz4_bomb():
    packed = lz4_zeros(3 * GIB // 2)
    return HEADER + PAIR + chunk(b"", size=1000, packed=packed, kind="lz4") + END


def many_chunks(count):
    empty = chunk(b"", kind="", packed=b"") * count
    return HEADER + PAIR + empty + chunk(b"".join(sines(20))) + END


def chunk_indexed(times):
    start = HEADER + PAIR
    data = chunk(b"".join(sines(200)))
    index = struct.pack("<QQQQ", EPOCH_NS, EPOCH_NS + 10**9, len(start), len(data))
    index += struct.pack("<IQ", 0, 0) + text("zstd") + struct.pack("<QQ", len(data) - 60, 30_000)
    body = start + data + record(15, struct.pack("<I", 0))
    summary = PAIR + record(8, index) * times
    return body + summary + record(2, struct.pack("<QQI", len(body), 0, 0)) + MAGIC


def many_channels(count, *, joints):
    head = schema() if joints else schema(1, "std_msgs/msg/String")
    payload = joint_state(EPOCH_NS, ["a"], [0.1]) if joints else b"\0\1\0\0" + text("x\0")
    records = (
        channel(number, f"/t{number}") + message(number, EPOCH_NS + number, payload)
        for number in range(1, count + 1)
    )
    return HEADER + chunk(b"".join([head, *records])) + END


def many_joints(count):
    names, values = [f"j{k}" for k in range(count)], [0.1] * count
    times = [EPOCH_NS + tick * PERIOD_NS for tick in range(4)]
    rows = [message(n, t, joint_state(t, names, values)) for t in times for n in (1, 2)]
    return HEADER + chunk(PAIR + b"".join(rows)) + END


def many_names():
    """Every message has a joint of its own."""
    payloads = (joint_state(EPOCH_NS, [f"j{tick}"], [0.1]) for tick in range(20_000))
    rows = (message(1 + k % 2, EPOCH_NS + k * 10**6, data) for k, data in enumerate(payloads))
    return HEADER + chunk(PAIR + b"".join(rows)) + END


def jump(step_ns):
    return HEADER + PAIR + chunk(b"".join(sines(300, step_ns))) + END


def empty_payloads():
    rows = list(sines(60))
    return HEADER + PAIR + chunk(b"".join(rows) + message(2, EPOCH_NS + 10**10, b"")) + END


def counts_that_lie():
    good = joint_state(EPOCH_NS, ["a"], [0.1])
    rows = [
        good[:at] + struct.pack("<I", value) + good[at + 4 :]
        for at in range(12, len(good) - 4, 4)
        for value in (2**32 - 1, 2**31, 2**28)
    ]
    inside = b"".join(message(1 + k % 2, EPOCH_NS + k * 10**7, row) for k, row in enumerate(rows))
    return HEADER + PAIR + chunk(inside) + END


def schema_of(data):
    log = HEADER + schema(1, "a/msg/B", data) + channel(1, "/joint_states")
    return log + message(1, EPOCH_NS, bytes(64)) + END


def nested_schema():
    parts = [f"N{k + 1} x\n{'=' * 80}\nMSG: a/N{k + 1}\n" for k in range(5000)]
    return schema_of("".join(parts) + "uint8 x\n")


def looped_schema():
    return schema_of(f"B x\n{'=' * 80}\nMSG: a/B\nB x\n")


def offsets_that_lie():
    body = HEADER + PAIR + b"".join(sines(30)) + record(15, struct.pack("<I", 0))
    return body + PAIR + record(2, struct.pack("<QQI", 2**63, 2**64 - 1, 7)) + MAGIC


def lengths_that_lie():
    rows = HEADER + PAIR + b"".join(sines(10))
    return rows + b"".join(struct.pack("<BQ", kind, 2**62) for kind in (5, 6, 9, 12)) + bytes(100)


def chunk_in_chunk():
    inside = PAIR + b"".join(sines(5))
    for _ in range(200):
        inside = chunk(inside)
    return HEADER + inside + END


def images():
    """Constant images: they pack 10,000 times and more, and are honest."""
    name = "sensor_msgs/msg/Image"
    text_of = "uint32 height\nuint32 width\nuint8[] data\n"
    payload = b"\0\1\0\0" + struct.pack("<III", 1500, 2000, 3_000_000) + bytes(3_000_000)
    inside = schema(3, name, text_of) + channel(3, "/camera", 3)
    chunks = [chunk(inside + message(3, EPOCH_NS + k * 10**9, payload)) for k in range(20)]
    return HEADER + PAIR + b"".join(chunks) + chunk(b"".join(sines(200))) + END


def attached(content):
    body = struct.pack("<QQ", 0, 0) + text("robot.toml") + text("application/toml")
    body += struct.pack("<Q", len(content)) + content.encode() + struct.pack("<I", 0)
    return HEADER + record(9, body) + PAIR + b"".join(sines(60)) + END


READ = (
    *("log info {f}", "log check {f}", "log recover {f} -o new.mcap", "analyse {f}"),
    "log cut {f} --start 0 --stop 1 -o new.mcap",
)
MORE = (
    *(*READ, "log export {f} -o new.csv", "view {f} --save new.rrd", "report {f} -o new.html"),
    *("log info {f} --json", "log merge {f} gait.mcap -o new.mcap", "compare {f} gait.mcap"),
)
DAY_NS = 86_400 * 10**9
LOGS = {
    "4 GiB behind 1,000 bytes": (partial(bomb, size=4 * GIB, declared=1000), READ),
    "4 GiB, size not stated": (partial(bomb, size=4 * GIB, declared=1000, stated=False), READ),
    "2 GiB, honest": (partial(bomb, size=2 * GIB, declared=2 * GIB), READ),
    "2 GiB, cut": (partial(bomb, size=2 * GIB, declared=1000, cut=40), READ),
    "1.5 GiB of LZ4": (lz4_bomb, READ),
    "100,000 empty chunks": (partial(many_chunks, 100_000), READ),
    "a chunk indexed 10,000 times": (partial(chunk_indexed, 10_000), READ),
    "65,535 channels": (partial(many_channels, 65_535, joints=False), READ),
    "8,000 joint topics": (partial(many_channels, 8000, joints=True), MORE),
    "100,000 joints": (partial(many_joints, 100_000), MORE),
    "20,000 names": (many_names, MORE),
    "a clock that jumps a day": (partial(jump, DAY_NS), MORE),
    "a clock that jumps a year": (partial(jump, 365 * DAY_NS), MORE),
    "a clock that jumps back": (partial(jump, -365 * DAY_NS), MORE),
    "log times from 2^63": (partial(jump, 2**63 - EPOCH_NS), MORE),
    "an empty payload": (empty_payloads, MORE),
    "counts that lie": (counts_that_lie, MORE),
    "a schema nested 5,000 deep": (nested_schema, MORE),
    "a schema in itself": (looped_schema, MORE),
    "offsets that lie": (offsets_that_lie, READ),
    "lengths that lie": (lengths_that_lie, READ),
    "chunks in chunks": (chunk_in_chunk, READ),
    "constant images": (images, READ[:4]),
    "a robot nested 5,000 deep": (lambda: attached("a = " + "[" * 5000 + "]" * 5000), MORE),
    "a robot of 1e308 kg": (lambda: attached(ROBOT.replace("mass = 0.1", "mass = 1e308")), MORE),
}
WORDS = {
    "a folder": (
        *("analyse folder", "report folder -o new.html", "compare folder gait.mcap"),
        *("view folder --save new.rrd", "log info folder", "log check folder"),
    ),
    "a folder to plan from": (
        "plan lag-sweep --like folder -o new",
        "plan reversal --like folder -o new",
    ),
    "no place to write": (
        "plan multisine --like gait.mcap -o /proc/new",
        "sim run scenario.toml -o /proc/new.mcap",
        "log cut gait.mcap -o /proc/new.mcap",
        "analyse gait.mcap -o /proc/new.json",
        "report gait.mcap -o /proc/n.html",
    ),
    "wrong words": (
        *("--bogus", "--", "log", "", "log info", "log info ''", "sim run ''", "'\x1b[2J'"),
    ),
    "masses of 1e308": ("sim run heavy.toml -o new.mcap", "drive heavy.toml --on twin -o new.mcap"),
}

HELP = ("", "log")
"""Words that are no mistake: the list of commands is printed."""

COUNT = len(LOGS) + len(WORDS)


def run(seed, stage):
    """Run one command on a hostile log, or hostile words; each log gets each command in turn."""
    number = seed % 1_000_000
    name = [*LOGS, *WORDS][number % COUNT]
    lines = LOGS[name][1] if name in LOGS else WORDS[name]
    turn = (number + number // COUNT + seed // 1_000_000) % len(lines)
    line = lines[turn].format(f="hostile.mcap")
    with stage.fresh() as folder:
        heavy = {"robot.toml": ROBOT.replace("mass = 0.1", "mass = 1e308")}
        heavy["heavy.toml"] = SCENARIO.replace("snake4.toml", "robot.toml")
        log = {"hostile.mcap": _kept(stage, name)} if name in LOGS else {}
        write_files(folder, stage.files_of("gait.mcap") | heavy | log)
        (folder / "folder").mkdir()
        outcome = run_command(shlex.split(line), folder)
        result = Result(f"{line!r}: {name}")
        result.add(outcome)
        result.failures += check_output(folder)
        if name == "constant images" and b"error:" in outcome.err:
            result.failures.append(f"refused: {outcome.errors}")
        if name in WORDS and outcome.code == 0 and line not in HELP:
            result.failures.append("accepted: exit code 0")
        if name == "wrong words" and outcome.code == 1 and "''" not in line:
            result.failures.append("exit code: 1 for wrong usage")
    return result


def _kept(stage, name):
    """Return a log, made once."""
    path = Path(stage.folder) / f"hostile-{list(LOGS).index(name)}"
    if not path.exists():
        part = path.with_suffix(".part")
        part.write_bytes(LOGS[name][0]())
        part.rename(path)
    return path.read_bytes()
