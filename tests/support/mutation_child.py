"""Reads mutated files: a script for the tests in ``test_mutations.py``, its memory bounded.

It is no test module. Each seed stands for one mutated file; it is announced before it is read, so
that whoever waits can name the one that hangs. What is not an error of ours is told with its trace.
"""

import json
import random
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as Ros2Writer

from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import UndulogError
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages.definitions import schema_text
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.log.sinks.durable_sink import DurableSink
from undulog.capture.log.wal.reader import recover
from undulog.capture.robot.description import parse_robot

sys.path.insert(0, str(Path(__file__).parents[1]))
from campaign.mutate import mutate_bytes

EPOCH_NS = 1_700_000_000_000_000_000
MIB = 1 << 20
ROOM = 1 << 30
"""Address space beyond what the process has when it begins [byte]."""
GROWTH = 192 * MIB
"""Memory in use beyond that [byte]: far less than any size that a mutated header claims."""

NAMES = ["joint01", "joint02"]
FIELDS = ("position", "velocity", "effort")
# -- whole files ---------------------------------------------------------------------------


def write_session(path, ticks=8, robot=None, sink=None):
    """A small session of ours with one channel of each kind."""
    facts = {"operator": "a person"}
    with SessionWriter(
        path, session_id="s", epoch_ns=EPOCH_NS, robot=robot, metadata=facts, sink=sink
    ) as writer:
        joint = writer.joint_state
        states = joint("/joint_states", NAMES, unit="rad", velocity=True, effort=True)
        offsets = joint("/joint_sample_offset", NAMES, unit="s")
        frames = writer.frames("/can/can0")
        sonar = writer.range(
            "/sonar", frame="head", min_range=0.1, max_range=2.0, field_of_view=0.1
        )
        mode, events = writer.string("/gait/mode"), writer.log()
        for tick in range(ticks):
            t_ns = EPOCH_NS + tick * 10_000_000
            states.write(t_ns, [0.1, tick], [1.0, 2.0], [0.5, np.nan])
            offsets.write(t_ns, [0.0, 1e-3])
            batch = empty_frames(3)
            batch["t_host_ns"] = batch["t_device_ns"] = t_ns
            batch["id_flags"], batch["dlc"] = [513, 514, 769], 8
            frames.write(t_ns, batch)
            sonar.write(t_ns, 0.5)
            if tick % 4 == 0:
                mode.write(t_ns, "walk")
                events.write(t_ns, "warn", "tests", f"tick {tick}")
        writer.set_verdict("good", ["nothing to say"])


def write_foreign(path):
    """A session of mcap-ros2-support: one message a servo."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        text = schema_text("sensor_msgs/msg/JointState")
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", text)
        for tick in range(12):
            t_ns = EPOCH_NS + tick * 10_000_000
            seconds, rest = divmod(t_ns, 10**9)
            message = {
                "header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": ""},
                "name": [NAMES[tick % 2]],
                "position": [float(tick)],
                "velocity": [],
                "effort": [],
            }
            writer.write_message("/joint_states", schema, message, log_time=t_ns)
        writer.finish()


def rewrite(source, path, **options):
    """The same records as another make writes them."""
    with source.open("rb") as stream, path.open("wb") as out:
        reader = make_reader(stream)
        writer = McapWriter(out, **options)
        writer.start("ros2", "another make")
        schemas, channels = {}, {}
        for schema, channel, message in reader.iter_messages():
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                0, EPOCH_NS, attachment.name, attachment.media_type, attachment.data
            )
        writer.finish()


def freeze_unfinished(folder):
    """A session as a killed recorder leaves it: a file without an end, and its log."""
    path = folder / "recording" / "run.mcap"
    path.parent.mkdir()
    sink = DurableSink(path, segment_size=1 << 16, ballast=0)
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, sink=sink) as writer:
        states = writer.joint_state("/joint_states", NAMES, unit="rad")
        for tick in range(40):
            states.write(EPOCH_NS + tick * 10_000_000, [0.1, tick])
        shutil.copytree(path.parent, folder / "unfinished")
    return folder / "unfinished"


def make_corpus(folder):
    """Whole files: name to the files of one session."""
    ours = folder / "ours.mcap"
    write_session(ours, robot=load_robot("snake13"))
    plain = folder / "plain.mcap"
    write_session(plain)
    write_foreign(folder / "foreign.mcap")
    no_crc = {"compression": CompressionType.NONE, "enable_crcs": False}
    rewrite(plain, folder / "lz4.mcap", compression=CompressionType.LZ4, chunk_size=2000)
    rewrite(plain, folder / "small.mcap", chunk_size=700)
    rewrite(plain, folder / "open.mcap", **no_crc, chunk_size=1500)
    rewrite(plain, folder / "bare.mcap", **no_crc, use_chunking=False)
    rewrite(plain, folder / "lone.mcap", **no_crc, index_types=IndexType.NONE, chunk_size=3000)
    return {path.name: [path] for path in sorted(folder.glob("*.mcap"))} | {
        "unfinished": sorted(p for p in freeze_unfinished(folder).rglob("*") if p.is_file())
    }


# -- mutations -----------------------------------------------------------------------------


WORDS = [
    "", "0", "-1", "1e400", "nan", "99999999999999999999", "[]", "{}", '"', "'", "=", "\0", "\n",
    "{joint}", "@0-", "|", "64|64@0+", "SG_", "BO_", "BU_", "é", "\ufeff", "[[bus]]", "[bus]",
    "true",
]  # fmt: skip


def mutate_text(text, rng):
    """Text with one to four faults, in characters or in words."""
    for _ in range(rng.choice([1, 1, 2, 4])):
        if rng.random() < 0.3:
            text = mutate_bytes(text.encode(), rng).decode("utf-8", "replace")
            continue
        a = rng.randrange(len(text) + 1)
        b = min(len(text), a + rng.choice([0, 0, 1, 3, 20]))
        text = text[:a] + rng.choice(WORDS) + text[b:]
    return text


# -- reading -------------------------------------------------------------------------------


def read_session(path):
    """Everything that a session offers; errors of ours are answers too."""
    parts = [lambda: check_session(path)]
    with Session(path) as session:
        parts += [
            lambda: session.robot,
            lambda: (session.session_id, session.verdict, session.metadata, session.attachments),
            lambda: (session.start_ns, session.end_ns, session.duration_s),
        ]
        for topic in session.channels:
            parts.append(lambda t=topic: session.table(t))
            parts.append(lambda t=topic: session.table(t, start_ns=EPOCH_NS + 30_000_000))
            parts.append(lambda t=topic: sum(1 for _ in session.messages(t)))
            if topic.startswith("/can"):
                parts.append(lambda t=topic: session.frames(t))
            if topic.startswith("/joint"):
                parts += [lambda t=topic, f=f: session.joints(t, f) for f in FIELDS]
                part = {"start_ns": EPOCH_NS + 20_000_000, "stop_ns": EPOCH_NS + 50_000_000}
                parts.append(lambda t=topic, w=part: session.joints(t, **w))
        answered = 0
        for part in parts:
            try:
                part()
                answered += 1
            except UndulogError:
                continue
        return f"read {answered} of {len(parts)}, {len(session.warnings)} warnings"


def read_log(folder):
    """What a write-ahead log still has."""
    recovery = recover(folder)
    found = sum(1 for _ in recovery)
    return f"recovered {found}, {recovery.missing} missing"


def parse_mutated(rng):
    """A robot description, or its bus database, with faults."""
    robot = load_robot(rng.choice(["snake25", "arcsnake-joint"]))
    databases = dict(robot.databases)
    text = robot.toml
    if rng.random() < 0.5:
        text = mutate_text(text, rng)
    else:
        name = rng.choice(sorted(databases))
        databases[name] = mutate_text(databases[name], rng)
    parse_robot(text, source="mutated.toml", databases=databases)
    return "parsed"


def try_seed(seed, corpus, folder):
    """Read the file that a seed stands for; gives what came of it."""
    rng = random.Random(seed)
    kind = seed % 10
    try:
        if kind == 9:
            return parse_mutated(rng)
        name = "unfinished" if kind >= 7 else rng.choice([n for n in corpus if n != "unfinished"])
        files = corpus[name]
        chosen = rng.choice(files)
        place = folder / "mutated"
        shutil.rmtree(place, ignore_errors=True)
        for path in files:
            target = place / path.relative_to(files[0].parent)
            target.parent.mkdir(parents=True, exist_ok=True)
            data = path.read_bytes()
            target.write_bytes(mutate_bytes(data, rng) if path == chosen else data)
        if kind == 8:
            return read_log(place / "run.mcap.wal")
        return read_session(place / ("run.mcap" if name == "unfinished" else name))
    except UndulogError as error:
        str(error)
        return f"refused: {type(error).__name__}"


def in_use():
    """Most memory in use so far [byte]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main():
    """Read the seeds from the first argument to before the second; one line of JSON for each."""
    first, stop = map(int, sys.argv[1:3])
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        corpus = make_corpus(folder)
        for files in corpus.values():  # everything that is loaded lazily is loaded now
            read_session(files[0].parent / ("run.mcap" if len(files) > 1 else files[0].name))
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
        before = in_use()
        for seed in range(first, stop):
            print(json.dumps({"begin": seed}), flush=True)
            result = {"seed": seed}
            try:
                result["came"] = try_seed(seed, corpus, folder)
            except BaseException as error:  # noqa: BLE001 (every stray one is what is looked for)
                result["stray"] = type(error).__name__
                result["trace"] = traceback.format_exc(limit=-12)
            result["grown"] = in_use() - before
            print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
