"""Messages of other types than JointState as samples of joints, and rows as one series per joint.

A message of ros2_control may hold commands and states: then each has a name of its own,
``TOPIC.PART``, such as ``/arm/controller_state.reference``. A name may also list the joints of an
array without names: ``TOPIC:JOINT,JOINT``. Neither character is valid in a topic's name.

Definitions: https://github.com/ros-controls/control_msgs,
https://github.com/ros2/common_interfaces.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.arrays import NS, FloatArray, IntArray
from ...common.errors import DataError
from ..columns.layouts import Group, names_of
from ..columns.names import distinct_names, one_name_sentences
from ..messages.cdr import LITTLE_ENDIAN_HEADER, Layout
from ..messages.definitions import (
    CONTROLLER_STATE,
    DYNAMIC_STATE,
    FLOAT_ARRAYS,
    JOINT_LISTS,
    JOINT_STATE,
    TRAJECTORY,
    Field,
    MessageType,
)

JOINT_TYPES = (*JOINT_LISTS, *FLOAT_ARRAYS, TRAJECTORY)
"""Types that hold joints."""

COMMAND_PARTS = ("reference", "desired", "output")
STATE_PARTS = ("feedback", "actual")
"""Fields of a controller state, in order of preference; the second ones are of older versions."""

UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
"""Field of a JointState to its unit, if the channel states no other."""

INTERFACE_UNITS = {"current": "A", "voltage": "V", "temperature": "degC"}
"""Further interfaces of a DynamicJointState that the log contract has topics for."""

_POINT_FIELDS = {"position": "positions", "velocity": "velocities", "effort": "effort"}
_JOINTS = "joint_names["
_MOST_POINTS = 100_000
_LATEST_NS = 1 << 61  # a later start is damage, and the times of its points have no place

_TRAJECTORY_FIELDS = ["header", "joint_names", "points"]

_U32, _TIME = struct.Struct("<I"), struct.Struct("<iI")

_EARLY_OR_LATE = 0.1
"""A joint that is missing for more than this part of the topic's span causes a warning."""


@dataclass(frozen=True)
class JointSource:
    """A name under which joints are read.

    Attributes:
        topic: The topic in the log.
        part: Field of a controller state, or interface of a DynamicJointState; may be empty.
        joints: Names of the values of an array.
    """

    name: str
    topic: str
    part: str = ""
    joints: tuple[str, ...] = ()


def joint_source(name: str, topics: Mapping[str, Any]) -> JointSource | None:
    """Return what a name stands for; None if its topic is not among those of a log."""
    if name in topics:
        return JointSource(name, name)
    topic, colon, listed = name.partition(":")
    if colon and topic in topics:
        joints = tuple(part.strip() for part in listed.split(","))
        if "" in joints or len(set(joints)) < len(joints):
            raise DataError(f"{name}: after the colon each joint has one name, with commas between")
        return JointSource(name, topic, joints=joints)
    at = name.find(".")
    while at >= 0:
        if name[:at] in topics:
            return JointSource(name, name[:at], name[at + 1 :])
        at = name.find(".", at + 1)
    return None


def leaf_paths(source: JointSource, type_name: str, fields: Iterable[str]) -> list[str] | None:
    """Return the leaf paths that hold some fields of joints; None for all paths."""
    if type_name == CONTROLLER_STATE:
        return [f"{source.part}.{_POINT_FIELDS[field]}" for field in fields]
    if type_name == DYNAMIC_STATE:
        return None
    return ["data"] if type_name in FLOAT_ARRAYS else list(fields)


def check_source(source: JointSource, kind: MessageType) -> None:
    """Check that a type has the fields that a source needs.

    Raises:
        DataError: If it has not; the message names those it has.
    """
    topic, fields = source.topic, {field.name: field for field in kind.fields}
    if kind.name not in JOINT_TYPES:
        readable = ", ".join(name.replace("/msg/", "/") for name in JOINT_TYPES)
        raise DataError(f"{topic} is {kind.name}, not of joints ({readable})")
    if not is_of_joints(kind):
        raise DataError(f"{topic}: its schema is not that of {kind.name}")
    if kind.name == CONTROLLER_STATE:
        there = [part for part in (*COMMAND_PARTS, *STATE_PARTS, "error") if part in fields]
        if source.part not in there:
            raise DataError(
                f"{topic} has several sets of joints: name one of "
                f"{', '.join(f'{topic}.{part}' for part in there)}"
            )
    elif source.part and kind.name != DYNAMIC_STATE:
        raise DataError(f"{topic} is {kind.name}, which has no part {source.part!r}")
    if kind.name in FLOAT_ARRAYS and not source.joints:
        raise DataError(
            f"{topic} is {kind.name}, whose values have no names: name its joints in their order, "
            f"{topic}:JOINT,JOINT,..."
        )
    if kind.name not in FLOAT_ARRAYS and source.joints:
        raise DataError(f"{topic} is {kind.name}, which names its joints itself")


def is_of_joints(kind: MessageType) -> bool:
    """Whether a type has the fields of its name that are read."""
    fields = {field.name: field for field in kind.fields}
    if kind.name in FLOAT_ARRAYS:
        data = fields.get("data")
        return data is not None and data.is_array and data.base in ("float64", "float32")
    stamp = _parts(_parts(fields.get("header")).get("stamp"))
    if not {"sec", "nanosec"} <= stamp.keys():
        return False
    names = fields.get("name" if kind.name == JOINT_STATE else "joint_names")
    if names is None or names.base != "string" or not names.is_array:
        return False
    if kind.name == JOINT_STATE:
        arrays = [fields.get(name) for name in UNITS]
        return all(array is not None and array.is_array and array.base for array in arrays)
    if kind.name == DYNAMIC_STATE:
        parts = _parts(fields.get("interface_values"))
        bases = {name: part.base for name, part in parts.items()}
        return bases == {"interface_names": "string", "values": "float64"}
    points = _parts(fields.get("points" if kind.name == TRAJECTORY else "error"))
    return all(
        name in points and points[name].base == "float64" for name in _POINT_FIELDS.values()
    ) and (kind.name != TRAJECTORY or [field.name for field in kind.fields] == _TRAJECTORY_FIELDS)


def _parts(field: Field | None) -> dict[str, Field]:
    nested = None if field is None else field.nested
    return {} if nested is None else {part.name: part for part in nested.fields}


def sampled(
    source: JointSource, type_name: str, group: Group, field: str
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the joints of messages of one layout, and their values of a field.

    Returns:
        k names, and values of shape (n, k), or (n, 0) if these messages leave the field empty.

    Raises:
        DataError: If the values of an array are not as many as the joints that were named.
    """
    if type_name == CONTROLLER_STATE:
        (path,) = leaf_paths(source, type_name, [field]) or [""]
        names, values = names_of(group.layout, _JOINTS), group.values(path)
    elif type_name == DYNAMIC_STATE:
        names, values = _interface(group, source.part, field)
    elif type_name in FLOAT_ARRAYS:
        names, values = source.joints, group.values("data")
        if field != "position":
            values = values[:, :0]
        elif values.shape[1] not in {0, len(names)}:
            raise DataError(
                f"{source.topic} has {values.shape[1]} values in a message, but {len(names)} "
                f"joints are named: {', '.join(names)}"
            )
    else:
        names, values = names_of(group.layout), group.values(field)
    return names, values.astype(np.float64, copy=False)


def _interface(group: Group, part: str, field: str) -> tuple[tuple[str, ...], FloatArray]:
    """Return the joints that have an interface, and its values."""
    interface = (part if field == "position" else None) if part else field
    names: list[str] = []
    columns: list[FloatArray] = []
    listed = interfaces(group.layout)
    for j, name in enumerate(names_of(group.layout, _JOINTS)):
        present = listed.get(j, ())
        if interface is None or interface not in present:
            continue
        values = group.values(f"interface_values[{j}].values")
        if values.shape[1] == len(present):
            names.append(name)
            columns.append(values[:, present.index(interface)])
    if not columns:
        return (), np.empty((len(group), 0))
    return tuple(names), np.stack(columns, axis=1)


def interfaces(layout: Layout) -> dict[int, list[str]]:
    """Return the interfaces of a DynamicJointState by the place of their joint."""
    by_joint: dict[int, list[str]] = {}
    for path, text in layout.strings.items():
        if path.startswith("interface_values["):
            place = path.removeprefix("interface_values[").partition("]")[0]
            by_joint.setdefault(int(place), []).append(text)
    return by_joint


def carried(source: JointSource, type_name: str, layout: Layout) -> dict[str, tuple[str, ...]]:
    """Return the fields that messages of one layout fill, each with the joints that have it."""
    leaves = layout.leaves
    if type_name == DYNAMIC_STATE:
        listed = interfaces(layout)
        every = enumerate(names_of(layout, _JOINTS))
        pairs = [(name, listed.get(j, ())) for j, name in every]
        requested = {"position": source.part} if source.part else {field: field for field in UNITS}
        filled = {
            field: tuple(name for name, there in pairs if interface in there)
            for field, interface in requested.items()
        }
    elif type_name in FLOAT_ARRAYS:
        filled = {"position": source.joints if "data" in leaves else ()}
    elif type_name == CONTROLLER_STATE:
        names = names_of(layout, _JOINTS)
        paths = {field: f"{source.part}.{_POINT_FIELDS[field]}" for field in UNITS}
        filled = {field: names for field, path in paths.items() if path in leaves}
    else:
        filled = {field: names_of(layout) for field in UNITS if field in leaves}
    return {field: names for field, names in filled.items() if names}


@dataclass(frozen=True)
class JointTrajectory:
    """The points of one message.

    Attributes:
        log_ns: Its log time [Unix ns].
        stamp_ns: Of its header [ns]; 0 for "from now on".
        after_ns: Times of the points from its start [ns], shape (n,).
        values: Field of a JointState to its values, shape (n, k), or (n, 0) if points lack it.
    """

    log_ns: int
    stamp_ns: int
    names: tuple[str, ...]
    after_ns: IntArray
    values: Mapping[str, FloatArray]


class _Cursor:
    """Reads the parts of one CDR message in order."""

    def __init__(self, message: bytes) -> None:
        self._message, self._at = message, len(LITTLE_ENDIAN_HEADER)

    def _take(self, size: int, align: int) -> int:
        at = self._at + (4 - self._at) % align  # relative to the end of the header of 4 bytes
        if at + size > len(self._message):
            raise DataError(f"the message ends at byte {len(self._message)}, not {at + size}")
        self._at = at + size
        return at

    def count(self) -> int:
        return int(_U32.unpack_from(self._message, self._take(4, 4))[0])

    def time_ns(self) -> int:
        sec, nanosec = _TIME.unpack_from(self._message, self._take(8, 4))
        return int(sec) * NS + int(nanosec)

    def text(self) -> str:
        size = self.count()
        at = self._take(size, 1)
        return self._message[at : at + max(size - 1, 0)].decode("utf-8", "replace")

    def numbers(self) -> FloatArray:
        count = self.count()
        at = self._take(8 * count, 8) if count else 0
        return np.frombuffer(self._message, np.float64, count, at)


def read_trajectory(log_ns: int, message: bytes) -> JointTrajectory:
    """Decode a ``trajectory_msgs/JointTrajectory``.

    Raises:
        DataError: If it is damaged, or no little-endian CDR.
    """
    if message[:2] != LITTLE_ENDIAN_HEADER[:2]:
        raise DataError(f"encapsulation {message[:2].hex()} is not little-endian CDR")
    cursor = _Cursor(message)
    stamp_ns, _ = cursor.time_ns(), cursor.text()
    names = distinct_names([cursor.text() for _ in range(cursor.count())])
    count = cursor.count()
    if count > _MOST_POINTS:
        raise DataError(f"a trajectory of {count} points can't be right")
    after_ns = np.zeros(count, np.int64)
    rows: dict[str, list[FloatArray]] = {field: [] for field in UNITS}
    for k in range(count):
        position, velocity, _, effort = (cursor.numbers() for _ in range(4))
        after_ns[k] = cursor.time_ns()
        for field, values in zip(UNITS, (position, velocity, effort), strict=True):
            rows[field].append(values)
    values = {
        field: np.array(row).reshape(count, len(names))
        if all(len(point) == len(names) for point in row)
        else np.empty((count, 0))
        for field, row in rows.items()
    }
    return JointTrajectory(log_ns, stamp_ns, names, after_ns, values)


def trajectories(
    messages: Iterable[tuple[int, bytes]], warn: Callable[[str], None]
) -> Iterator[JointTrajectory]:
    """Decode trajectories; ``warn`` is called once if some are damaged."""
    lost, why = 0, ""
    for log_ns, message in messages:
        try:
            yield read_trajectory(log_ns, message)
        except DataError as error:
            lost, why = lost + 1, str(error)
    if lost:
        warn(f"{lost} messages can't be read: {why}")


def points_in_force(
    every: Sequence[JointTrajectory], field: str, shift_ns: int
) -> tuple[list[tuple[tuple[str, ...], IntArray, FloatArray]], int]:
    """Return the points of trajectories as commands.

    A trajectory starts at its stamp, or when it was logged if the stamp is zero. From the time of
    its first point on it replaces those before it.

    Args:
        every: The trajectories of a topic.
        shift_ns: To add to stamps [ns].

    Returns:
        For each list of k joints its names, times [Unix ns], shape (n,), and values, shape (n, k);
        and the number of points that were replaced.
    """
    parts: dict[tuple[str, ...], list[tuple[IntArray, FloatArray]]] = {}
    first: dict[tuple[str, ...], int] = {}
    replaced = 0
    in_order = sorted(every, key=lambda message: message.log_ns)
    for trajectory in reversed(in_order):
        values = trajectory.values[field]
        if not values.shape[1] or not len(values):
            continue
        start_ns = trajectory.stamp_ns + shift_ns if trajectory.stamp_ns else trajectory.log_ns
        t_ns = min(start_ns, _LATEST_NS) + trajectory.after_ns
        kept = t_ns < first.get(trajectory.names, np.iinfo(np.int64).max)
        replaced += int((~kept).sum())
        if kept.any():
            parts.setdefault(trajectory.names, []).append((t_ns[kept], values[kept]))
        first[trajectory.names] = min(int(t_ns[0]), first.get(trajectory.names, int(t_ns[0])))
    points = [
        (
            names,
            np.concatenate([t_ns for t_ns, _ in reversed(part)]),
            np.concatenate([values for _, values in reversed(part)]),
        )
        for names, part in parts.items()
    ]
    return points, replaced


@dataclass(frozen=True)
class JointRows:
    """Messages that carry the same joints.

    Attributes:
        names: The joints, k of them.
        stamp_ns: header.stamp [ns], shape (n,).
        log_ns: Log time [Unix ns], shape (n,).
        values: Shape (n, k), or (n, 0) if these messages leave the field empty.
    """

    names: tuple[str, ...]
    stamp_ns: IntArray
    log_ns: IntArray
    values: FloatArray


def rows_of(source: JointSource, type_name: str, group: Group, field: str) -> JointRows:
    """Return the rows of messages of one layout, in log order; without stamps at log times."""
    log_ns = group.times()
    stamp_ns = group.stamps()
    names, values = sampled(source, type_name, group, field)
    if (np.diff(log_ns) < 0).any():  # a file need not be in log order, a reader must be
        logged = np.argsort(log_ns, kind="stable")
        stamp_ns, log_ns, values = stamp_ns[logged], log_ns[logged], values[logged]
    return JointRows(names, stamp_ns, log_ns, values)


def merge_rows(
    rows: Sequence[JointRows], topic: str, field: str, warn: Callable[[str], None]
) -> tuple[tuple[str, ...], list[IntArray], list[FloatArray]]:
    """Merge messages of all layouts to one series per joint.

    Args:
        rows: The messages, by layout.
        warn: Called with one sentence for each irregularity.

    Returns:
        Joint names in the order of a list that has all, else of first appearance; times [Unix ns]
        and values, one array per joint. Joints sampled together share one array of times.
    """
    filled = [row for row in rows if row.names and row.values.shape[1] == len(row.names)]
    for row in rows:
        if row.names and row.values.shape[1] not in {0, len(row.names)}:
            warn(
                f"{topic}: {len(row.stamp_ns)} messages have {len(row.names)} names but "
                f"{row.values.shape[1]} values of {field}; they are left out"
            )
    for sentence in one_name_sentences(row.names for row in filled):
        warn(f"{topic}: {sentence}")
    if len(filled) == 1:
        row = filled[0]
        t_ns, order = _in_time(row.stamp_ns, f"{topic}", warn)
        values = row.values if order is None else row.values[order]
        if values.strides[0] != values.itemsize:  # a joint's samples side by side
            values = np.asfortranarray(values)
        return row.names, [t_ns] * len(row.names), [values[:, j] for j in range(len(row.names))]
    # A list that has all joints gives their order; a shorter one may come first.
    longest = max((row.names for row in filled), key=len, default=())
    parts: dict[str, list[tuple[JointRows, int]]] = {}
    if len(longest) == len({name for row in filled for name in row.names}):
        parts = {name: [] for name in longest}
    for row in filled:
        for j, name in enumerate(row.names):
            parts.setdefault(name, []).append((row, j))
    times: list[IntArray] = []
    columns: list[FloatArray] = []
    for name, pieces in parts.items():
        log_ns = np.concatenate([row.log_ns for row, _ in pieces])
        logged = np.argsort(log_ns, kind="stable")
        stamps = np.concatenate([row.stamp_ns for row, _ in pieces])[logged]
        values = np.concatenate([row.values[:, j] for row, j in pieces])[logged]
        t_ns, order = _in_time(stamps, f"{topic}, {name}", warn)
        times.append(t_ns)
        columns.append(values if order is None else values[order])
    _warn_changed_set(tuple(parts), times, topic, warn)
    return tuple(parts), times, columns


def _in_time(
    t_ns: IntArray, where: str, warn: Callable[[str], None]
) -> tuple[IntArray, IntArray | None]:
    """Sort times; return also the order if they were unsorted. Duplicates cause a warning."""
    steps = np.diff(t_ns)
    backward, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    order: IntArray | None = None
    if backward:
        warn(f"{where}: {backward} samples go back in time; sorted by their stamps")
        order = np.argsort(t_ns, kind="stable")
        t_ns = t_ns[order]
        repeated = int((np.diff(t_ns) == 0).sum())
    if repeated:
        warn(f"{where}: {repeated} samples repeat the stamp before them; all are kept")
    return t_ns, order


def _warn_changed_set(
    names: Sequence[str], times: Sequence[IntArray], topic: str, warn: Callable[[str], None]
) -> None:
    """Warn of joints that are missing at the start or end of the topic."""
    filled = [t for t in times if len(t)]
    if not filled:
        return
    start, stop = min(int(t[0]) for t in filled), max(int(t[-1]) for t in filled)
    slack = _EARLY_OR_LATE * (stop - start)
    partial = [
        name
        for name, t in zip(names, times, strict=True)
        if not len(t) or t[0] - start > slack or stop - t[-1] > slack
    ]
    if partial:
        warn(
            f"{topic}: the set of joints changes during the session; only part of it has "
            f"{', '.join(partial)}"
        )
