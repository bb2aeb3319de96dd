"""ROS 2 bags of another make: MCAP by Foxglove's ``mcap``, JointStates in CDR by hand.

The messages are laid out in NumPy, all of one topic at once: a hundred seeds of every fault are
some hundred million numbers. A test reads them back with ``mcap_ros2``.
"""

import numpy as np
from mcap.writer import CompressionType, Writer

from .robot import SECOND_TOPIC

EPOCH_NS = 1_700_000_000_000_000_000

JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def write_bag(log, path):
    """Write a log to a file, replaced if it exists; return the file."""
    robot = log.robot
    topics = ["/joint_commands", "/joint_states"] + [SECOND_TOPIC] * (log.second is not None)
    rows = _messages(0, robot.names, robot.sent_s, [robot.sent(), None, None])
    topics_of = ((log.position, log.velocity, log.effort), (log.second, None, None))
    for number, (position, *others) in enumerate(topics_of, 1):
        if position is None:
            continue
        groups = [[j] for j in range(robot.m)] if robot.per_servo else [list(range(robot.m))]
        for group in groups:
            times = robot.t_s[:, group[0]]
            columns = [None if other is None else other[:, group] for other in (position, *others)]
            if robot.per_servo:  # a message that was lost is not there
                kept = np.isfinite(position[:, group[0]])
                times = times[kept]
                columns = [None if column is None else column[kept] for column in columns]
            rows += _messages(number, [robot.names[j] for j in group], times, columns)
    rows.sort(key=lambda row: row[:2])
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start(profile="ros2", library="fault zoo")
        kind = ("sensor_msgs/msg/JointState", "ros2msg", JOINT_STATE.encode())
        schema = writer.register_schema(*kind)
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        for t_ns, number, data in rows:
            writer.add_message(channels[number], t_ns, data, t_ns)
        writer.finish()
    return path


def _messages(number, names, times_s, columns):
    """Time, topic's number and CDR of each message, in order of time."""
    count, text = len(names), b"".join(map(_text, names))
    # Offsets count from after the encapsulation: stamp 8, empty frame id 4 + 1 and 3 to align.
    at = 8 + 8 + 4 + len(text)
    fields = [("head", "V4"), ("sec", "<i4"), ("ns", "<u4"), ("frame", "V8"), ("names", "<u4")]
    fields.append(("text", f"V{len(text)}"))
    values = {}
    for key, column in zip(("position", "velocity", "effort"), columns, strict=True):
        fields.append((f"{key}_count", "<u4"))
        at += 4
        if column is not None:
            fields += [(f"{key}_pad", f"V{-at % 8}")] if at % 8 else []
            fields.append((key, "<f8", (count,)))
            at += -at % 8 + 8 * count
            values[key] = column
    t_ns = EPOCH_NS + np.rint(np.asarray(times_s) * 1e9).astype(np.int64)
    rows = np.zeros(len(t_ns), dtype=fields)
    rows["head"] = b"\0\1\0\0"
    rows["sec"], rows["ns"] = t_ns // 10**9, t_ns % 10**9
    rows["frame"] = b"\1\0\0\0\0\0\0\0"
    rows["names"] = count
    rows["text"] = text
    for key, column in values.items():
        rows[f"{key}_count"] = count
        rows[key] = column
    return [(int(t), number, row.tobytes()) for t, row in zip(t_ns, rows, strict=True)]


def _text(name):
    data = name.encode() + b"\0"
    return len(data).to_bytes(4, "little") + data + b"\0" * (-len(data) % 4)
