"""Channels of a session: each encodes samples of one kind as messages.

A channel of fixed layout holds one template message; a sample costs a few writes into it and
one copy.

Every ``write`` takes the sampling time ``t_ns`` and the time of recording ``log_time_ns``, both in
Unix ns; the latter is the sampling time if None. It raises LogWriteError if the file can't be
written.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...common.arrays import NS, FloatArray, IntArray
from ...common.errors import DataError
from ..mcap.chunk import BODY_AT
from ..messages.cdr import Leaf, encode, layout_of
from ..messages.definitions import JOINT_STATE, DiagnosticStatus, message_type
from ..messages.frames import (
    FD_FRAME_DTYPE,
    FD_FRAME_LAYOUT,
    FRAME_DTYPE,
    FRAME_LAYOUT,
    FrameArray,
    frame_message,
)

Send = Callable[[int, int, bytes], None]
"""Writes one message: log time [ns], publish time [ns], bytes."""

SendRows = Callable[[IntArray, IntArray, NDArray[np.uint8]], None]
"""Writes messages of one size: log times [ns], publish times [ns], (n,), and the records of a
:class:`.MessageBatch`, (n, BODY_AT + size)."""

_Fields: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]
"""Paths of fields, each with the shape of its numbers in a message."""

_TIME = struct.Struct("<iI")
_STAMP = "header.stamp.sec", "header.stamp.nanosec"
_END_NS = 2**31 * NS
_AT_ONCE = 1 << 20  # bytes of messages: a chunk
_POSE_STEP = 2.0**-14  # transforms are a view aid: rounded, they compress

_LEVELS = {"debug": 10, "info": 20, "warn": 30, "error": 40, "fatal": 50}


@dataclass(frozen=True)
class Template:
    """A message of fixed layout, filled again for every sample.

    Attributes:
        leaves: Fields of numbers by path.
    """

    message: bytearray
    leaves: dict[str, Leaf]
    send: Send
    send_rows: SendRows
    _layouts: dict[_Fields, np.dtype[np.void]] = field(
        default_factory=dict[_Fields, np.dtype[np.void]]
    )

    def view(self, path: str) -> NDArray[Any]:
        """Return the numbers of one field, as a writable view of the message.

        Args:
            path: Field path, e.g. ``position``.

        Returns:
            Shape (count,); empty if the message does not have the field.
        """
        leaf = self.leaves.get(path)
        if leaf is None:
            return np.empty(0, dtype=np.float64)
        return np.frombuffer(self.message, dtype=leaf.dtype, count=leaf.count, offset=leaf.offset)

    def emit_rows(
        self, t_ns: IntArray, log_time_ns: IntArray | None, values: Mapping[str, FloatArray]
    ) -> None:
        """Write many messages at once.

        Args:
            t_ns: Sampling time of each [Unix ns], shape (n,).
            log_time_ns: Time of recording of each [Unix ns]; the sampling time if None.
            values: Field path to numbers, shape (n,), or (n, count) for an array and for a field
                with those behind it; the other fields are the template's.

        Raises:
            DataError: If a time isn't from 1970 to 2038, which a stamp can hold.
            ValueError: If a shape doesn't fit the field.
        """
        if len(t_ns) and t_ns.view(np.uint64).max() >= _END_NS:  # a negative one is huge
            raise DataError(f"times from {t_ns.min()} to {t_ns.max()} ns don't fit 32 bits of s")
        log_ns = t_ns if log_time_ns is None else log_time_ns
        layout = self._layout(tuple((path, value.shape[1:]) for path, value in values.items()))
        size = layout.itemsize
        step = max(1, _AT_ONCE // size)
        records = np.empty((min(step, len(t_ns)), size), np.uint8)
        records[:, BODY_AT:] = np.frombuffer(self.message, np.uint8)
        for at in range(0, len(t_ns), step):
            times_ns = t_ns[at : at + step]
            mine = records[: len(times_ns)]
            rows = mine.view(layout)[:, 0]
            rows[_STAMP[0]], rows[_STAMP[1]] = np.divmod(times_ns, NS)
            for path, numbers in values.items():
                rows[path] = numbers[at : at + step]
            self.send_rows(log_ns[at : at + step], times_ns, mine)

    def _layout(self, fields: _Fields) -> np.dtype[np.void]:
        """Return the record of a message, with its stamp and some of its fields."""
        layout = self._layouts.get(fields)
        if layout is None:
            named = [*((path, ()) for path in _STAMP), *fields]
            leaves = [self.leaves[path] for path, _ in named]
            layout = self._layouts[fields] = np.dtype(
                {
                    "names": [path for path, _ in named],
                    "formats": [
                        (leaf.dtype, shape) for leaf, (_, shape) in zip(leaves, named, strict=True)
                    ],
                    "offsets": [BODY_AT + leaf.offset for leaf in leaves],
                    "itemsize": BODY_AT + len(self.message),
                }
            )
        return layout

    def emit(self, t_ns: int, log_time_ns: int | None, stamps: Sequence[int]) -> None:
        """Stamp and write the message.

        Args:
            t_ns: Sampling time [Unix ns].
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.
            stamps: Byte offsets of the header stamps in the message.
        """
        seconds, nanoseconds = divmod(t_ns, NS)
        for at in stamps:
            _TIME.pack_into(self.message, at, seconds, nanoseconds)
        self.send(t_ns if log_time_ns is None else log_time_ns, t_ns, bytes(self.message))


class _Stamped:
    """A channel whose messages have one header; ``_fields`` are the paths that it fills."""

    _fields: ClassVar[Sequence[str]] = ()

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        self._template = template
        self._stamps = (template.leaves["header.stamp.sec"].offset,)
        self._views = [template.view(path) for path in self._fields]

    def _emit(self, t_ns: int, log_time_ns: int | None) -> None:
        self._template.emit(t_ns, log_time_ns, self._stamps)

    def _emit_numbers(self, t_ns: int, log_time_ns: int | None, values: Iterable[float]) -> None:
        for view, value in zip(self._views, values, strict=True):
            view[0] = value
        self._template.emit(t_ns, log_time_ns, self._stamps)

    def _emit_first(self, t_ns: IntArray, log_time_ns: IntArray, values: FloatArray) -> None:
        """Write many messages; values of the first fields, which lie side by side, (n, count)."""
        self._template.emit_rows(t_ns, log_time_ns, {self._fields[0]: values})


class JointStateChannel(_Stamped):
    """One value (and velocity, effort) per joint."""

    _fields = ("position", "velocity", "effort")

    def write(
        self,
        t_ns: int,
        position: ArrayLike,
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """Write one sample.

        Args:
            position: In the channel's unit, shape (m,).
            velocity: [rad/s], shape (m,), or empty if the channel has none.
            effort: [N m], shape (m,), or empty if the channel has none.

        Raises:
            ValueError: If a shape doesn't fit the channel.
        """
        positions, velocities, efforts = self._views
        positions[...] = position
        velocities[...] = velocity
        efforts[...] = effort
        self._emit(t_ns, log_time_ns)

    def write_rows(
        self,
        t_ns: IntArray,
        position: FloatArray,
        velocity: FloatArray,
        effort: FloatArray,
        *,
        log_time_ns: IntArray | None = None,
    ) -> None:
        """Write many samples at once; see :meth:`write`.

        Args:
            t_ns: Sampling times [Unix ns], shape (n,).
            position: Shape (n, m).
            velocity: [rad/s], shape (n, m), or (n, 0) if the channel has none.
            effort: [N m], shape (n, m), or (n, 0) if the channel has none.

        Raises:
            ValueError: If a shape doesn't fit the channel.
        """
        given = zip(self._fields, (position, velocity, effort), self._views, strict=True)
        values: dict[str, FloatArray] = {}
        for path, numbers, view in given:
            if numbers.shape != (len(t_ns), len(view)):
                raise ValueError(f"{path} has the shape {numbers.shape}, not (n, {len(view)})")
            if len(view):
                values[path] = numbers
        self._template.emit_rows(t_ns, log_time_ns, values)

    def part(self, names: Sequence[str]) -> JointStateChannel:
        """Return the channel for messages of some of the joints only, with the same fields."""
        kind, zeros = message_type(JOINT_STATE), [0.0] * len(names)
        fields = zip(self._fields, self._views, strict=True)
        values = {field: zeros if len(view) else [] for field, view in fields}
        example = encode(kind, {"name": list(names), **values})
        leaves = layout_of(kind, example).leaves
        whole = self._template
        template = Template(bytearray(example), leaves, whole.send, whole.send_rows)
        return JointStateChannel(template)


class OdometryChannel(_Stamped):
    """Pose and velocity of the head."""

    _fields = (
        *(f"pose.pose.position.{axis}" for axis in "xyz"),
        *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
        *(f"twist.twist.linear.{axis}" for axis in "xyz"),
        *(f"twist.twist.angular.{axis}" for axis in "xyz"),
    )

    def write(
        self,
        t_ns: int,
        position: FloatArray,
        quaternion: FloatArray,
        linear_velocity: FloatArray,
        angular_velocity: FloatArray,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """Write one sample.

        Args:
            position: Centre of the head link in the world [m], shape (3,).
            quaternion: Its orientation, x, y, z, w, shape (4,).
            linear_velocity: In the head's frame [m/s], shape (3,).
            angular_velocity: In the head's frame [rad/s], shape (3,).
        """
        values = (*position, *quaternion, *linear_velocity, *angular_velocity)
        self._emit_numbers(t_ns, log_time_ns, values)


class TransformChannel:
    """Poses of many frames."""

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        self._template = template
        self._stamps = self._offsets("header.stamp.sec")
        self._poses = self._offsets("transform.translation.x")

    def _offsets(self, field: str) -> list[int]:
        leaves = self._template.leaves
        return [leaf.offset for path, leaf in leaves.items() if path.endswith(f"].{field}")]

    def write(
        self,
        t_ns: int,
        positions: FloatArray,
        quaternions: FloatArray,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """Write one sample of all k frames.

        Args:
            positions: [m], shape (k, 3).
            quaternions: x, y, z, w, shape (k, 4).
        """
        rows = np.round(np.concatenate([positions, quaternions], axis=1) / _POSE_STEP) * _POSE_STEP
        for at, row in zip(self._poses, rows, strict=True):
            self._template.message[at : at + 56] = row.astype("<f8").tobytes()
        self._template.emit(t_ns, log_time_ns, self._stamps)


class RangeChannel(_Stamped):
    """One distance."""

    _fields = ("range",)

    def write(self, t_ns: int, value: ArrayLike, *, log_time_ns: int | None = None) -> None:
        """Write one sample.

        Args:
            value: Distance [m], shape () or (1,); +inf if nothing is in range (REP 117).
        """
        self._views[0][:] = value
        self._emit(t_ns, log_time_ns)

    def write_rows(self, t_ns: IntArray, values: FloatArray, log_time_ns: IntArray) -> None:
        """Write many samples at once, shape (n, 1); see :meth:`write`."""
        self._emit_first(t_ns, log_time_ns, values)


class MagneticFieldChannel(_Stamped):
    """One magnetic field."""

    _fields = tuple(f"magnetic_field.{axis}" for axis in "xyz")

    def write(self, t_ns: int, vector: FloatArray, *, log_time_ns: int | None = None) -> None:
        """Write one sample.

        Args:
            vector: In the sensor's frame [T], shape (3,).
        """
        self._emit_numbers(t_ns, log_time_ns, vector)

    def write_rows(self, t_ns: IntArray, values: FloatArray, log_time_ns: IntArray) -> None:
        """Write many samples at once, shape (n, 3); see :meth:`write`."""
        self._emit_first(t_ns, log_time_ns, values)


class ImuChannel(_Stamped):
    """Specific force and angular velocity."""

    _fields = (
        *(f"linear_acceleration.{axis}" for axis in "xyz"),
        *(f"angular_velocity.{axis}" for axis in "xyz"),
        "angular_velocity_covariance",
    )

    def write(
        self,
        t_ns: int,
        acceleration: FloatArray,
        angular_velocity: FloatArray | None = None,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """Write one sample.

        Args:
            acceleration: Specific force in the sensor's frame [m/s^2], shape (3,).
            angular_velocity: [rad/s], shape (3,), or None without a gyroscope, which sets the
                first covariance to -1 (REP 145).
        """
        gyro = (0.0, 0.0, 0.0) if angular_velocity is None else angular_velocity
        covariance = -1.0 if angular_velocity is None else 0.0
        self._emit_numbers(t_ns, log_time_ns, (*acceleration, *gyro, covariance))

    def write_rows(self, t_ns: IntArray, values: FloatArray, log_time_ns: IntArray) -> None:
        """Write many samples without a gyroscope at once, shape (n, 3); see :meth:`write`."""
        for view, unknown in zip(self._views[3:], (0.0, 0.0, 0.0, -1.0), strict=True):
            view[0] = unknown
        self._emit_first(t_ns, log_time_ns, values)


class TimeReferenceChannel(_Stamped):
    """A device's clock against the host's."""

    def write(self, t_host_ns: int, t_device_ns: int, *, log_time_ns: int | None = None) -> None:
        """Write one pair of times.

        Args:
            t_host_ns: Host time [Unix ns].
            t_device_ns: The device's own time at that moment [ns since its own epoch]; 0 to
                2**31 s.

        Raises:
            DataError: If the message can't hold the device's time.
        """
        message, at = self._template.message, self._template.leaves["time_ref.sec"].offset
        try:
            _TIME.pack_into(message, at, *divmod(t_device_ns, NS))
        except struct.error as error:
            raise DataError(
                f"a device time of {t_device_ns} ns doesn't fit 32 bits of s"
            ) from error
        self._emit(t_host_ns, log_time_ns)


class _Encoded:
    """A channel whose messages are encoded one by one."""

    _type: ClassVar[str]

    def __init__(self, send: Send) -> None:
        """Wrap a function that writes a message."""
        self._send = send

    def _encode(self, t_ns: int, log_time_ns: int | None, values: Mapping[str, Any]) -> None:
        log_time = t_ns if log_time_ns is None else log_time_ns
        self._send(log_time, t_ns, encode(message_type(self._type), values))


class StringChannel(_Encoded):
    """Text that changes now and then."""

    _type = "std_msgs/msg/String"

    def write(self, t_ns: int, text: str, *, log_time_ns: int | None = None) -> None:
        """Write one text."""
        self._encode(t_ns, log_time_ns, {"data": text})


class LogChannel(_Encoded):
    """Events and faults."""

    _type = "rcl_interfaces/msg/Log"

    def write(
        self, t_ns: int, level: str, name: str, text: str, *, log_time_ns: int | None = None
    ) -> None:
        """Write one event.

        Args:
            level: ``debug``, ``info``, ``warn``, ``error`` or ``fatal``.
            name: The component, e.g. ``twin``.

        Raises:
            DataError: If the level is none of these.
        """
        if level not in _LEVELS:
            raise DataError(f"level {level!r} is none of {', '.join(_LEVELS)}")
        values = {"stamp": _stamp(t_ns), "level": _LEVELS[level], "name": name, "msg": text}
        self._encode(t_ns, log_time_ns, values)


class DiagnosticsChannel(_Encoded):
    """The states of the recorder's components."""

    _type = "diagnostic_msgs/msg/DiagnosticArray"

    def write(self, t_ns: int, statuses: Sequence[DiagnosticStatus]) -> None:
        """Write the states of one moment."""
        listed = [
            {
                "level": status.level,
                "name": status.name,
                "message": status.message,
                "hardware_id": status.hardware_id,
                "values": [{"key": k, "value": v} for k, v in status.values.items()],
            }
            for status in statuses
        ]
        self._encode(t_ns, None, {"header": {"stamp": _stamp(t_ns)}, "status": listed})


class FrameChannel:
    """Raw CAN frames of one kind, classic or CAN FD."""

    def __init__(self, send: Send, *, fd: bool = False) -> None:
        """Wrap a function that writes a message; ``fd``: the frames are CAN FD frames."""
        self._send = send
        self._dtype = FD_FRAME_DTYPE if fd else FRAME_DTYPE
        self._layout = FD_FRAME_LAYOUT if fd else FRAME_LAYOUT

    def write(self, t_ns: int, frames: FrameArray) -> None:
        """Write a batch of frames.

        Args:
            t_ns: Log time of the batch [Unix ns]; each frame has its own times inside.
            frames: Records of :data:`.FRAME_DTYPE`, on a channel of CAN FD
                frames :data:`.capture.log.messages.frames.FD_FRAME_DTYPE`, shape (n,).

        Raises:
            DataError: If the records have another layout.
        """
        if frames.dtype != self._dtype:
            raise DataError(f"frames have the layout {frames.dtype}, not {self._dtype}")
        self._send(t_ns, t_ns, frame_message(frames, self._layout, self._dtype))


def _stamp(t_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(t_ns, NS)
    return {"sec": seconds, "nanosec": nanoseconds}
