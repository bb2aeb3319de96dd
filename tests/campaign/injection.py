"""Text that acts on a terminal, a page, a spreadsheet or a path, in every name of a file."""

import contextlib
import csv
import random
import re
import shlex

import numpy as np
from mcap_ros2.writer import Writer as RosWriter

from undulog.capture.log.messages.definitions import schema_text

from .base import DBC, EPOCH_NS, JOINTS, PERIOD_NS, PLAN, ROBOT, SCENARIO, can_messages, write_files
from .case import Result, run_command
from .commands import COMMANDS
from .fuzz import check_output
from .mutate import remake_log

EVIL = [
    "\x1b]0;owned\x07", "\x1b[2J\x1b[H", "\x1b]52;c;b3duZWQ=\x07", "fine\rerror: forged",
    "a\nb: good", "\x9b31m", "\u202egnp.exe", "\u2028", "\x00", "\x08\x08\x08", "\x7f",
    '=HYPERLINK("http://x")', "@SUM(1+1)", "+1+1|cmd", "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>", "a|b", "[x](javascript:alert(1))", "`#`", "../../up",
    "/etc/x", "{{7*7}}", "%s%n",
    "\ud83d\ude00".encode("utf-16", "surrogatepass").decode("utf-16"), "[bold red]x[/]",
    "$HOME", "x" * 3000,
]  # fmt: skip
HTML = re.compile(rb"<script>alert\(1\)|<img src=x onerror|href=\"javascript:", re.IGNORECASE)
TEXTS = ("toml", "dbc", "scenario", "plan", "trace", "columns")


def _evil_session(path, rng):
    """Write a foreign bag with such names of joints and topics, texts of events, and metadata."""

    favourite = rng.choice(EVIL)

    def evil(name):
        evil_text = rng.choice([favourite, rng.choice(EVIL)])
        return rng.choice([name, name + evil_text, evil_text + name])

    names = [evil(name) for name in JOINTS]
    kind, log = "sensor_msgs/msg/JointState", "rcl_interfaces/msg/Log"
    with path.open("wb") as stream:
        writer = RosWriter(stream)
        schema = writer.register_msgdef(kind, schema_text(kind))
        events = writer.register_msgdef(log, schema_text(log))
        other = evil("/joint_other")
        for tick in range(200):
            t_ns = EPOCH_NS + tick * PERIOD_NS
            seconds, rest = divmod(t_ns, 10**9)
            stamp = {"sec": seconds, "nanosec": rest}
            for topic, lag in (("/joint_commands", 0.0), ("/joint_states", 0.2), (other, 0.0)):
                angles = 0.3 * np.sin(0.3 * tick + np.arange(len(names)) - lag)
                if topic == "/joint_states" and tick > 100:
                    angles[1] = 0.0  # one that stands still has to be named
                header = {"stamp": stamp, "frame_id": evil("f") if tick == 3 else ""}
                row = {"header": header, "name": names, "position": angles.tolist()}
                writer.write_message(topic, schema, row, log_time=t_ns)
            if tick % 40 == 0:
                texts = {"name": evil("node"), "msg": evil("text"), "file": evil("file")}
                event = {"stamp": stamp, "level": 40, **texts}
                writer.write_message("/rosout", events, event, log_time=t_ns)
        inner = writer._writer
        facts = {evil(key): evil("x") for key in ("session_id", "operator", "notes", "robot", "x")}
        inner.add_metadata("undulog", facts | {"session_id": evil("s")})
        health = {"verdict": evil("good"), "reasons": f'["{evil("r")}"]'}
        inner.add_metadata("undulog.health", health)
        inner.add_metadata(evil("name"), {"a": evil("b")})
        inner.add_attachment(0, 0, evil("robot.toml"), evil("text/plain"), b"x")
        writer.finish()


def _spoil(text, rng):
    """Return a TOML or DBC text in which some strings are evil."""

    def worse(match):
        if rng.random() > 0.15:
            return match.group()
        evil_text = match.group(1) + rng.choice(EVIL)
        if rng.random() < 0.5:  # raw control characters are no TOML: escaped ones are
            evil_text = "".join(
                f"\\u{ord(c):04x}" if ord(c) < 0xA0 and not c.isalnum() else c for c in evil_text
            )
        return f'"{evil_text}"'

    return re.sub(r'"([^"\n]*)"', worse, text)


def run(seed, stage):
    """Run one command on evil names in one of the files that it reads."""
    rng = random.Random(seed)
    with stage.fresh() as folder:
        texts = {"snake4.toml": ROBOT, "snake4.dbc": DBC, "scenario.toml": SCENARIO}
        write_files(folder, texts | {"gait0.mcap": stage.files_of("gait.mcap")["gait.mcap"]})
        kind = rng.choice(["log", "log", "log", "foreign", *TEXTS])
        line = _lay_out(kind, folder, rng, stage)
        result = Result(f"{line!r}: {kind}")
        result.add(run_command(shlex.split(line), folder))
        result.failures += check_output(folder) + _check_pages(folder)
        outside = [str(path) for path in folder.parent.iterdir() if path.name.startswith("up")]
        result.failures += [f"path: wrote {path}" for path in outside]
    return result


def _lay_out(kind, folder, rng, stage):
    """Write the spoilt file; return the command line to run on it."""
    trace = folder / "trace.log"
    with trace.open("w") as stream:
        for m in can_messages():
            stream.write(f"({m.timestamp:.6f}) can0 {m.arbitration_id:03X}#{m.data.hex()}\n")
    if kind in {"log", "foreign"}:
        name = "evil.mcap"
        if rng.random() < 0.3:
            possible = [x for x in EVIL if "/" not in x and "\0" not in x and len(x) < 99]
            name = f"e{rng.choice(possible)}.mcap"
        _evil_session(folder / name, rng)
        if kind == "foreign":  # with faults besides, so that errors and warnings name things
            scratch = stage.folder / f"scratch{folder.parent.name}"
            (folder / name).write_bytes(remake_log((folder / name).read_bytes(), rng, scratch))
        lines = [line for _, line in COMMANDS["log"] if line != "api"]
        return rng.choice(lines).format(file=shlex.quote(name))
    imports = "import trace.log -o new.mcap -r snake4.toml"
    if kind == "toml":
        (folder / "snake4.toml").write_text(_spoil(ROBOT, rng))
    elif kind == "dbc":
        worse = DBC.replace("position", "position" + rng.choice(EVIL), 1)
        (folder / "snake4.dbc").write_text(worse)
    elif kind == "scenario":
        (folder / "scenario.toml").write_text(_spoil(SCENARIO + '[x]\ny = "z"\n', rng))
        return "sim run scenario.toml -o new.mcap"
    elif kind == "plan":
        (folder / "plan.toml").write_text(_spoil(PLAN, rng))
        return "drive plan.toml --on twin -o new.mcap"
    elif kind == "trace":
        which = rng.choice(["bus", "text", "id"])
        evil = rng.choice(EVIL)
        old, new = {"bus": ("can0", evil), "text": ("#", evil), "id": ("100#", evil + "#")}[which]
        text = trace.read_text().replace(old, new, rng.choice([1, -1]))
        trace.write_text(text, "utf-8", "replace")
    else:
        evil = rng.choice(EVIL).replace('"', "")
        rows = "".join(f"{k},{k},{evil}\n" for k in range(9))
        (folder / "table.csv").write_text(f"time,{evil},b\n{rows}")
        column = shlex.quote(evil.replace("\0", ""))
        imports = "import table.csv -o new.mcap -r snake4.toml --map time=time:s"
        return f"{imports} --map {column}=joint01.position:deg"
    return rng.choice([imports, "sim run scenario.toml -o new.mcap", imports + " --json"])


def _check_pages(folder):
    """Return markup from names in pages, and cells of tables that a spreadsheet computes."""
    markup = [
        f"page: {hit.group()!r} in {path.name}"
        for path in folder.glob("new*.html")
        if (hit := HTML.search(path.read_bytes()))
    ]
    for path in folder.glob("new*.csv"):
        with path.open(newline="", encoding="utf-8", errors="replace") as stream:
            for row in csv.reader(stream):
                for cell in row:
                    if cell[:1] in set("=@\t\r") or (
                        cell[:1] in set("+-") and not _is_number(cell)
                    ):
                        return [*markup, f"formula: {cell[:40]!r} in {path.name}"]
    return markup


def _is_number(cell):
    with contextlib.suppress(ValueError):
        float(cell)
        return True
    return False
