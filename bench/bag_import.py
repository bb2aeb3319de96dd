"""Reading JointStates from a rosbag2 ``.db3``: a session's columns, against rosbags decoding them.

python bench/bag_import.py [BAG]   processor time of each [s] and the ratio, which is to be <= 1.3
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from undulog.capture import Session

KIND = "sensor_msgs/msg/JointState"
STORE = get_typestore(Stores.LATEST)


def written(folder: Path, messages: int = 40_000, joints: int = 12) -> Path:
    """Write a bag of JointStates at 100 Hz."""
    types, none = STORE.types, np.zeros(0)
    names = [f"joint_{k}" for k in range(joints)]
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        way = writer.add_connection("/joint_states", KIND, typestore=STORE)
        for k in range(messages):
            stamp = types["builtin_interfaces/msg/Time"](sec=1 + k // 100, nanosec=k % 100 * 10**7)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            values = np.sin(0.05 * k - np.arange(joints))
            message = types[KIND](
                header=header, name=names, position=values, velocity=none, effort=none
            )
            t_ns = 10**9 + k * 10**7
            writer.write(way, t_ns, STORE.serialize_cdr(message, KIND))
    return folder


def measure(bag: Path) -> None:
    """Print both times, twice."""
    for _ in range(2):
        start = time.process_time()
        with Reader(bag) as reader:
            for connection, _t_ns, data in reader.messages():
                STORE.deserialize_cdr(data, connection.msgtype)
        middle = time.process_time()
        with Session.open(bag) as session:
            session.joints("/joint_states")
        peer, own = middle - start, time.process_time() - middle
        print(f"rosbags {peer:.3f} s, session {own:.3f} s, ratio {own / peer:.2f}")


if __name__ == "__main__":
    with TemporaryDirectory() as scratch:
        measure(Path(sys.argv[1]) if len(sys.argv) > 1 else written(Path(scratch, "bag")))
