"""Bags written by rosbags itself: joints in the messages of ros2_control, with a known response."""

import shutil
from dataclasses import dataclass

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EPOCH_NS = 1_700_000_000_000_000_000
NAMES = ("front_yaw", "mid_yaw", "rear_yaw")
GAIN, LAG = np.array([0.95, 0.9, 0.85]), np.array([0.1, 0.2, 0.3])
OMEGA, AMPLITUDE = 2 * np.pi * 0.8, 0.4
HOLD_S = 0.1
"""From the stamp of a streamed trajectory to its point."""

BY_FILE, BY_MESSAGE, BY_CHUNK = (
    (mode, CompressionFormat.ZSTD)
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE)
)
"""Compressions of a bag of ROS 2."""

POINT = "trajectory_msgs/JointTrajectoryPoint"
MULTI = "trajectory_msgs/MultiDOFJointTrajectoryPoint"
_PARTS = {
    # control_msgs 1.0 to 2.5, 3.0 to 4.0, 4.1 on (Humble), 5.0 to 5.2, 5.3 on.
    "foxy": (("desired", "actual", "error"), False, False),
    "galactic": (("desired", "actual", "error"), True, False),
    "humble": (("reference", "feedback", "error", "output", "desired", "actual"), True, False),
    "iron": (("reference", "feedback", "error", "output"), True, False),
    "jazzy": (("reference", "feedback", "error", "output"), True, True),
}
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
DYNAMIC = "control_msgs/msg/DynamicJointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
STATE = "sensor_msgs/msg/JointState"


def controller_state(version):
    """The definition of the message in one release of control_msgs."""
    parts, multi, speed = _PARTS[version]
    lines = ["std_msgs/Header header", "string[] joint_names", *(f"{POINT} {p}" for p in parts)]
    if multi:
        lines += ["string[] multi_dof_joint_names", *(f"{MULTI} multi_dof_{p}" for p in parts)]
    return "\n".join([*lines, *(["float64 speed_scaling_factor"] if speed else [])]) + "\n"


def typestore(version="jazzy", base=Stores.ROS2_HUMBLE):
    """Types of ROS with those of ros2_control, from the text of their definitions."""
    store = get_typestore(base)
    store.register(
        get_types_from_msg(controller_state(version), CONTROLLER)
        | get_types_from_msg(
            "std_msgs/Header header\nstring[] joint_names\n"
            "control_msgs/InterfaceValue[] interface_values\n",
            DYNAMIC,
        )
        | get_types_from_msg(
            "string[] interface_names\nfloat64[] values\n", "control_msgs/msg/InterfaceValue"
        )
    )
    return store


def message(store, kind, **values):
    """A message of some fields; the others are zero or empty."""
    filled = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        if name in values:
            filled[name] = values.pop(name)
        elif node == Nodetype.BASE:
            filled[name] = "" if detail[0] == "string" else 0
        elif node == Nodetype.NAME:
            filled[name] = message(store, detail)
        elif node == Nodetype.ARRAY:
            filled[name] = np.zeros(detail[1])
        else:
            numbers = detail[0][0] == Nodetype.BASE and detail[0][1][0] != "string"
            filled[name] = np.zeros(0, detail[0][1][0]) if numbers else []
    assert not values, values
    return store.types[kind](**filled)


def stamp(store, t_ns):
    kind = "builtin_interfaces/msg/Time"
    return store.types[kind](sec=int(t_ns // 10**9), nanosec=int(t_ns % 10**9))


def header(store, t_ns):
    return message(store, "std_msgs/msg/Header", stamp=stamp(store, t_ns))


def point(store, positions, after_ns=0, **fields):
    kind = "trajectory_msgs/msg/JointTrajectoryPoint"
    after = message(
        store,
        "builtin_interfaces/msg/Duration",
        sec=int(after_ns // 10**9),
        nanosec=int(after_ns % 10**9),
    )
    return message(store, kind, positions=positions, time_from_start=after, **fields)


@dataclass
class Bag:
    """A bag that is being written."""

    store: object
    writer: object
    ways: dict

    def write(self, topic, t_ns, sample):
        kind = sample.__msgtype__
        if topic not in self.ways:
            self.ways[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        ros1 = isinstance(self.writer, Writer1)
        encode = self.store.serialize_ros1 if ros1 else self.store.serialize_cdr
        self.writer.write(self.ways[topic], t_ns, bytes(encode(sample, kind)))


def write_bag(
    path, fill, *, storage=StoragePlugin.MCAP, store=None, compression=(), chunk_size=1 << 20
):
    """Write a bag: a folder of ROS 2, or a file of ROS 1 if its name ends in .bag.

    Args:
        compression: Arguments of the writer's ``set_compression``.
        chunk_size: Of a bag of ROS 1 [byte].
    """
    ros1 = path.suffix == ".bag"
    store = store or typestore(base=Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    writer = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(*compression)
    if ros1:
        writer.chunk_threshold = chunk_size
    with writer:
        fill(Bag(store, writer, {}))
    return path


def write_split(path, fills, **options):
    """Write a folder of two parts, as rosbag2 does when a file is full."""
    write_bag(path, fills[0], **options)
    second = write_bag(path.with_name(f"{path.name}_1"), fills[1], **options)
    (part,) = (file for file in second.iterdir() if file.name != "metadata.yaml")
    part.rename(path / part.name)
    shutil.rmtree(second)
    stated = path / "metadata.yaml"
    lines = stated.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if "relative_file_paths" in line) + 1
    lines.insert(at + 1, f"{lines[at].partition('-')[0]}- {part.name}")
    stated.write_text("\n".join(lines) + "\n")
    return path


def commanded(t_s):
    return AMPLITUDE * np.sin(OMEGA * t_s - np.arange(3))


def answered(t_s):
    return AMPLITUDE * GAIN * np.sin(OMEGA * t_s - np.arange(3) - LAG)


def ticks(seconds=10.0, rate=100):
    """Times of samples: Unix ns, and s since the first."""
    for k in range(int(seconds * rate)):
        yield EPOCH_NS + k * (10**9 // rate), k / rate


class Filler:
    """Writes one kind of message of the known response, with some noise, tick after tick."""

    def __init__(self, bag, seed=3):
        self.bag, self.draw = bag, np.random.default_rng(seed)

    def noisy(self, t_s):
        return answered(t_s) + self.draw.normal(0, 1e-3, 3)

    def state(self, t_ns, t_s, topic="/joint_states", positions=None, names=NAMES):
        store = self.bag.store
        values = self.noisy(t_s) if positions is None else np.array(positions, float)
        head = header(store, t_ns)
        sample = message(store, STATE, header=head, name=list(names), position=values)
        self.bag.write(topic, t_ns, sample)

    def controller(self, t_ns, t_s, topic="/arm/controller_state", names=("reference", "feedback")):
        store = self.bag.store
        reference, feedback = names
        sample = message(
            store,
            CONTROLLER,
            header=header(store, t_ns),
            joint_names=list(NAMES),
            **{reference: point(store, commanded(t_s)), feedback: point(store, self.noisy(t_s))},
        )
        self.bag.write(topic, t_ns, sample)

    def dynamic(self, t_ns, t_s, topic="/dynamic_joint_states"):
        store, positions = self.bag.store, self.noisy(t_s)
        names = ["position", "velocity", "effort", "current", "stiffness"]
        values = [
            message(
                store,
                "control_msgs/msg/InterfaceValue",
                interface_names=names,
                values=np.array([value, 0.1, 0.2, 0.3 + k, 5.0]),
            )
            for k, value in enumerate(positions)
        ]
        lamp = message(
            store,
            "control_msgs/msg/InterfaceValue",
            interface_names=["lamp"],
            values=np.array([1.0]),
        )
        sample = message(
            store,
            DYNAMIC,
            header=header(store, t_ns),
            joint_names=["gpio", *NAMES],
            interface_values=[lamp, *values],
        )
        self.bag.write(topic, t_ns, sample)

    def trajectory(self, t_ns, t_s, topic="/arm/joint_trajectory", *, count=1, stamped=True):
        """Points that are due HOLD_S after the stamp and each 10 ms later."""
        store = self.bag.store
        steps = [round(HOLD_S * 1e9) + k * 10**7 for k in range(count)]
        points = [point(store, commanded(t_s + step * 1e-9), step) for step in steps]
        head = header(store, t_ns if stamped else 0)
        names = list(NAMES)
        sample = message(store, TRAJECTORY, header=head, joint_names=names, points=points)
        self.bag.write(topic, t_ns, sample)

    def array(self, t_ns, t_s, topic="/forward/commands"):
        self.bag.write(topic, t_ns, message(self.bag.store, ARRAY, data=commanded(t_s)))


def filling(write, seconds=10.0, rate=100):
    """A fill for :func:`write_bag`; ``write`` gets a filler and the times of each tick."""

    def fill(bag):
        filler = Filler(bag)
        for tick in ticks(seconds, rate):
            write(filler, *tick)

    return fill
