"""Bags of sqlite3, by type: opened, and imported into a session, against rosbags decoding them.

Processor time in turn; the bar of the import is 1.3 times rosbags.

Run: python bench/bag_import.py [BAG] [--messages 40000] [--runs 3]

Without a bag it writes two: JointStates of 12 joints, and what ros2_control logs of them (states
and controller states), each 40,000 messages at 100 Hz.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from measuring import arguments, in_turn, took
from records import compared, versions
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from undulog.capture import Session
from undulog.capture.exchange.formats.rosbag.importing import import_bag

BAR = 1.3
STATE = "sensor_msgs/msg/JointState"
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
PARTS = ("reference", "feedback", "error", "output")
STORE = get_typestore(Stores.LATEST)
STORE.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\n"
        + "".join(f"{POINT} {part}\n" for part in PARTS),
        CONTROLLER,
    )
)


def written(folder: Path, kinds: tuple[str, ...], messages: int = 40_000, joints: int = 12) -> Path:
    """Write a bag at 100 Hz, the messages shared among the kinds."""
    types, none = STORE.types, np.zeros(0)
    names = [f"joint_{k}" for k in range(joints)]
    zero = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)

    def point(values: np.ndarray) -> object:
        return types[POINT](
            positions=values, velocities=values, accelerations=none, effort=none,
            time_from_start=zero,
        )  # fmt: skip

    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {STATE: "/joint_states", CONTROLLER: "/arm/controller_state"}
        ways = {kind: writer.add_connection(topics[kind], kind, typestore=STORE) for kind in kinds}
        for k in range(messages):
            kind, tick = kinds[k % len(kinds)], k // len(kinds)
            stamp = types["builtin_interfaces/msg/Time"](
                sec=1 + tick // 100, nanosec=tick % 100 * 10**7
            )
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            values = np.sin(0.05 * tick - np.arange(joints))
            if kind == STATE:
                message = types[STATE](
                    header=header, name=names, position=values, velocity=values, effort=none
                )
            else:
                parts = {part: point(values) for part in PARTS}
                message = types[CONTROLLER](header=header, joint_names=names, **parts)
            t_ns = 10**9 + tick * 10**7
            writer.write(ways[kind], t_ns, STORE.serialize_cdr(message, kind))
    return folder


def decode(bag: Path) -> None:
    """Decode all messages by rosbags."""
    with Reader(bag) as reader:
        for connection, _t_ns, data in reader.messages():
            STORE.deserialize_cdr(data, connection.msgtype)


def read(bag: Path) -> None:
    """Read commands and responses, found by type."""
    with Session.open(bag) as session:
        topics = session.joint_topics()
        names = {topics.command, topics.response}
        session.joint_columns({name: ["position"] for name in names if session.joint_channel(name)})


def brought_in(bag: Path) -> None:
    """Import a bag."""
    with TemporaryDirectory() as scratch:
        import_bag(bag, Path(scratch, "session.mcap"))


def measure(name: str, bag: Path, runs: int) -> bool:
    """Read and import one bag in turn; return whether the bar is met."""
    works = [partial(took, partial(work, bag)) for work in (read, brought_in, decode)]
    in_turn(1, *works)  # what is imported late is imported now
    opened, imported, peer = (
        [usage.processor_s for usage in turns] for turns in in_turn(runs, *works)
    )
    rosbags = versions("rosbags")
    compared(f"open and read a bag, {name}", opened, peer, rosbags)
    return compared(f"import a bag, {name}", imported, peer, rosbags, bar=BAR)


def main() -> int:
    """Measure one bag, or both that are written; return 1 if a bar is missed."""
    parser = arguments(__doc__, messages=40_000, runs=3)
    parser.add_argument("bag", type=Path, nargs="?")
    options = parser.parse_args()
    if options.bag is not None:
        return int(not measure(options.bag.name, options.bag, options.runs))
    with TemporaryDirectory() as scratch:
        bags = {
            name: written(Path(scratch, name), kinds, options.messages)
            for name, kinds in (("JointStates", (STATE,)), ("ros2_control", (STATE, CONTROLLER)))
        }
        good = [measure(name, bag, options.runs) for name, bag in bags.items()]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
