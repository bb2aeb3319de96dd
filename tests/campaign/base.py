"""Small whole files of every kind that the commands read.

CAN traces are written by python-can, foreign logs by the ``mcap`` packages.
"""

import shutil
from dataclasses import dataclass, field

import can
import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap_ros2.writer import Writer as RosWriter

from support.foreign_logs import rewrite
from support.processes import wait_for
from support.twin_chains import snake4
from support.written_frames import log_messages
from support.written_sessions import joint_state
from undulog.capture import SessionWriter, load_robot
from undulog.capture.log.messages.definitions import schema_text
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.log.write.durable_sink import DurableSink

EPOCH_NS = 1_700_000_000_000_000_000
JOINTS = ("joint01", "joint02", "joint03", "joint04")
PERIOD_NS = 20_000_000
DBC = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n' + "".join(
    f"""BO_ {base + number} {name}_{kind}: 8 A
 SG_ position : 0|16@1- (0.01,0) [-180|180] "deg" A
 SG_ velocity : 16|16@1- (0.1,0) [-3000|3000] "deg/s" A
 SG_ current : 32|16@1- (1,0) [-9000|9000] "mA" A
"""
    for base, kind in ((0x100, "command"), (0x200, "state"))
    for number, name in enumerate(JOINTS)
)
SIGNALS = (
    ("command", "position", "tx", "command", "deg"),
    ("state", "position", "rx", "position", "deg"),
    ("state", "velocity", "rx", "velocity", "deg/s"),
    ("state", "current", "rx", "current", "mA"),
)
ROBOT = snake4("snake4.dbc", SIGNALS)
SCENARIO = """
description = "Four joints on flat ground."
robot = "snake4.toml"
duration_s = 0.1
settle_s = 0.0
[gait]
ramp_s = 0.02
[gait.horizontal]
amplitude = 0.1
frequency_hz = 2.0
lag = 1.0
[gait.vertical]
amplitude = 0.05
frequency_hz = 2.0
lag = 0.5
"""
PLAN = """
description = "Two segments."
scenario = "scenario.toml"
[[segments]]
duration_s = 0.05
[[segments]]
duration_s = 0.05
transition_s = 0.02
mode = "fast"
horizontal = { frequency_hz = 1.0, amplitude = 0.05 }
"""
SETTINGS = """
[record]
sources = ["twin:scenario.toml"]
output = "run-{time}.mcap"
duration = "100ms"
floor = "1MB"
fast = true
quiet = true
split_size = "1MB"
operator = "a person"
metadata = { place = "tank 2" }
"""
COLUMNS = """
[time]
column = "time"
unit = "s"
[[columns]]
column = "angle"
joint = "joint01"
quantity = "position"
unit = "deg"
wrap = 360
[[columns]]
column = "torque"
joint = "joint02"
quantity = "effort"
unit = "N m"
"""


_PLAIN = {"compression": CompressionType.NONE, "enable_crcs": False}
MAKES = {
    "lz4": {"compression": CompressionType.LZ4, "chunk_size": 2000},
    "open": {**_PLAIN, "chunk_size": 1500},
    "bare": {**_PLAIN, "use_chunking": False},
    "lone": {**_PLAIN, "index_types": IndexType.NONE, "chunk_size": 3000},
    "cramped": {"chunk_size": 200},
}
"""How other makes write a log: options of its writer."""


@dataclass(frozen=True)
class Base:
    """Files that belong together.

    Attributes:
        kind: Key of its command lines.
        name: File or folder on the command line.
        files: Relative path to content.
        mutable: Paths in which faults are made.
    """

    kind: str
    name: str
    files: dict[str, bytes] = field(repr=False)
    mutable: tuple[str, ...]


def gait_session(path, ticks=200, sink=None):
    """Write four joints that follow sines, with frames, events and a reading of every kind."""
    facts = {"robot": load_robot(path.parent / "snake4.toml"), "metadata": {"operator": "x"}}
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, sink=sink, **facts) as writer:
        commands = writer.joint_state("/joint_commands", JOINTS, unit="rad")
        states = writer.joint_state("/joint_states", JOINTS, unit="rad", velocity=True, effort=True)
        offsets = writer.joint_state("/joint_sample_offset", JOINTS, unit="s")
        frames, events, mode = writer.frames("/can/can0"), writer.log(), writer.string("/gait/mode")
        sonar = writer.range("/sonar", frame="head", min_range=0.1, max_range=2, field_of_view=0.1)
        phase = 2 * np.pi * 1.5 * PERIOD_NS * 1e-9
        for tick in range(ticks):
            t_ns = EPOCH_NS + tick * PERIOD_NS
            turn = phase * tick + 0.7 * np.arange(len(JOINTS))
            noise = 1e-3 * np.sin(7.3 * turn)
            commands.write(t_ns, 0.3 * np.sin(turn))
            states.write(t_ns, 0.27 * np.sin(turn - 0.2) + noise, 2.5 * np.cos(turn), 0.1 * noise)
            if tick % 4 == 0:
                offsets.write(t_ns, [0.0, 1e-3, 2e-3, 3e-3])
                batch = empty_frames(8)
                batch["t_host_ns"] = batch["t_device_ns"] = t_ns
                batch["id_flags"] = [base + k for base in (0x100, 0x200) for k in range(4)]
                batch["dlc"], batch["dir"] = 8, [1] * 4 + [0] * 4
                frames.write(t_ns, batch)
            if tick % 50 == 0:
                mode.write(t_ns, "walk")
                sonar.write(t_ns, 0.5)
                events.write(t_ns, "warn", "tests", f"tick {tick}")
        writer.set_verdict("good", ["no fault"])


def foreign_session(path, ticks=240):
    """Write a bag by mcap-ros2-support: one message a servo, without a robot."""
    with path.open("wb") as stream:
        writer = RosWriter(stream, chunk_size=4000)
        kind = "sensor_msgs/msg/JointState"
        schema = writer.register_msgdef(kind, schema_text(kind))
        for tick in range(ticks):
            t_ns = EPOCH_NS + tick * PERIOD_NS
            for topic, lag in (("/joint_commands", 0.0), ("/joint_states", 0.2)):
                for k, name in enumerate(JOINTS[:2]):
                    angle = 0.3 * np.sin(0.25 * tick + k - lag)
                    message = joint_state(t_ns + k * 1000, [name], [angle])
                    writer.write_message(topic, schema, message, log_time=t_ns)
        writer.finish()


def write_logs(folder, ticks=200):
    """Write the session, a foreign one, and those of other makes beside the robot's files.

    Returns:
        File name to content.
    """
    gait, foreign = folder / "gait.mcap", folder / "foreign.mcap"
    gait_session(gait, ticks)
    foreign_session(foreign, ticks + 40)
    for name, options in MAKES.items():
        rewrite(gait, folder / f"{name}.mcap", **options)
    names = [f"{name}.mcap" for name in ("gait", "foreign", *MAKES)]
    return {name: (folder / name).read_bytes() for name in names}


def can_messages(count=160):
    """Yield commands and states of the small robot, a servo at a time."""
    for number in range(count):
        joint, state = number // 2 % 4, number % 2
        raw = round(1500 * np.sin(0.1 * number)) & 0xFFFF
        yield can.Message(
            timestamp=EPOCH_NS * 1e-9 + number * 0.005,
            arbitration_id=(0x200 if state else 0x100) + joint,
            is_extended_id=False,
            is_rx=bool(state),
            data=raw.to_bytes(2, "little") + bytes(6),
            channel=0,
        )


def write_files(folder, files):
    """Write texts or bytes by their relative paths."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.encode() if isinstance(data, str) else data)


def write_texts(folder):
    """Write robot, scenario, plan, settings and table; return name to content."""
    rows = "".join(f"{k / 100},{k % 360},{0.1 * k}\n" for k in range(80))
    texts = {
        "snake4.toml": ROBOT,
        "snake4.dbc": DBC,
        "scenario.toml": SCENARIO,
        "plan.toml": PLAN,
        "settings.toml": SETTINGS,
        "columns.toml": COLUMNS,
        "table.csv": "time,angle,torque\n" + rows,
    }
    write_files(folder, texts)
    return {name: text.encode() for name, text in texts.items()}


def files_below(folder):
    """Return the files of a folder: relative path to content."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def make_bases(folder, result_of):
    """Write all base files to an empty folder; ``result_of`` analyses a session, as JSON."""
    texts = write_texts(folder)
    logs = write_logs(folder)
    bases = [Base("log", name, {name: data, **texts}, (name,)) for name, data in logs.items()]
    bases += of_recorder(folder)
    for kind in ("log", "blf", "asc", "trc", "csv", "db"):
        path = log_messages(folder / f"trace.{kind}", can_messages())
        files = {path.name: path.read_bytes(), **texts}
        bases.append(Base("trace", path.name, files, (path.name,)))
    trace = {"trace.log": (folder / "trace.log").read_bytes(), **texts}
    of_text = {
        "table": ("table.csv", ("table.csv", "columns.toml")),
        "robot": ("trace.log", ("snake4.toml", "snake4.dbc")),
        "scenario": ("scenario.toml", ("scenario.toml", "snake4.toml")),
        "plan": ("plan.toml", ("plan.toml",)),
        "settings": ("settings.toml", ("settings.toml",)),
    }
    bases += [Base(kind, name, trace, mutable) for kind, (name, mutable) in of_text.items()]
    result = result_of(folder / "gait.mcap")
    files = {"gait.mcap": logs["gait.mcap"], "result.json": result, **texts}
    bases.append(Base("result", "gait.mcap", files, ("result.json",)))
    return bases


def of_recorder(folder):
    """Return the files that a killed recorder leaves, and a session in parts."""
    work, split = folder / "recorded", folder / "split"
    for path in (work, split):
        path.mkdir()
    texts = write_texts(work)
    robot = load_robot(work / "snake4.toml")

    def record(path, size, topics, at):
        sink = DurableSink(path, segment_size=size, ballast=0)
        facts = {"session_id": "s", "epoch_ns": EPOCH_NS, "robot": robot}
        with SessionWriter(path, sink=sink, **facts) as writer:
            channels = [writer.joint_state(topic, JOINTS, unit="rad") for topic in topics]
            for tick in range(150):
                for channel in channels:
                    angles = 0.3 * np.sin([tick / 8 + k for k in range(4)])
                    channel.write(EPOCH_NS + tick * PERIOD_NS, angles)
                at(tick, sink)

    def copy(tick, sink):
        if tick == 100:
            wait_for(lambda: not sink.backlog, "what was written is on the disk")
            shutil.copytree(work, folder / "unfinished")

    def divide(tick, sink):
        if tick in {50, 100}:
            sink.split()

    record(work / "run.mcap", 1 << 14, ("/joint_states", "/joint_commands"), copy)
    record(split / "run.mcap", 1 << 16, ("/joint_states",), divide)
    unfinished, parts = files_below(folder / "unfinished"), files_below(split)
    left = tuple(name for name in unfinished if name.startswith("run.mcap"))
    return [
        Base("unfinished", "run.mcap", unfinished, left),
        Base("split", next(iter(parts)), {**parts, **texts}, tuple(parts)),
    ]
