"""Channels of a session: each turns samples of one kind into messages.

A channel of fixed layout holds one template message; a sample costs a few writes into it and
one copy.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...common.arrays import FloatArray
from ...common.errors import DataError
from ..messages.cdr import Leaf, encode
from ..messages.definitions import DiagnosticStatus, message_type
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

_TIME = struct.Struct("<iI")
_NS = 1_000_000_000
_POSE_STEP = 2.0**-14  # transforms are a view aid: rounded, they compress

_LEVELS = {"debug": 10, "info": 20, "warn": 30, "error": 40, "fatal": 50}


@dataclass(frozen=True)
class Template:
    """A message of fixed layout, filled again for every sample.

    Attributes:
        leaves: Where its numbers are, by path.
    """

    message: bytearray
    leaves: dict[str, Leaf]
    send: Send

    def view(self, path: str) -> NDArray[Any]:
        """The numbers of one field, as a writable view of the message.

        Args:
            path: Field path, e.g. ``position``.

        Returns:
            Shape (count,); empty where the message has none.
        """
        leaf = self.leaves.get(path)
        if leaf is None:
            return np.empty(0, dtype=np.float64)
        return np.frombuffer(self.message, dtype=leaf.dtype, count=leaf.count, offset=leaf.offset)

    def emit(self, t_ns: int, log_time_ns: int | None, stamps: Sequence[int]) -> None:
        """Stamp and write the message.

        Args:
            t_ns: Sampling time [Unix ns].
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.
            stamps: Byte offsets of the header stamps in the message.
        """
        seconds, nanoseconds = divmod(t_ns, _NS)
        for at in stamps:
            _TIME.pack_into(self.message, at, seconds, nanoseconds)
        log_time = t_ns if log_time_ns is None else log_time_ns
        self.send(log_time, t_ns, bytes(self.message))


class _Stamped:
    """A channel whose messages have one header."""

    def __init__(self, template: Template) -> None:
        self._template = template
        self._stamps = (template.leaves["header.stamp.sec"].offset,)

    def _emit(self, t_ns: int, log_time_ns: int | None) -> None:
        self._template.emit(t_ns, log_time_ns, self._stamps)


class JointStateChannel(_Stamped):
    """One value (and velocity, effort) a joint."""

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        super().__init__(template)
        self._position = template.view("position")
        self._velocity = template.view("velocity")
        self._effort = template.view("effort")

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
            t_ns: Sampling time [Unix ns].
            position: In the channel's unit, shape (m,).
            velocity: [rad/s], shape (m,), or nothing where the channel has none.
            effort: [N m], shape (m,), or nothing where the channel has none.
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.

        Raises:
            ValueError: If a shape doesn't fit the channel.
            LogWriteError: If the file can't be written.
        """
        self._position[...] = position
        self._velocity[...] = velocity
        self._effort[...] = effort
        self._emit(t_ns, log_time_ns)


class OdometryChannel(_Stamped):
    """Pose and velocity of the head."""

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        super().__init__(template)
        fields = [f"pose.pose.position.{axis}" for axis in "xyz"]
        fields += [f"pose.pose.orientation.{axis}" for axis in "xyzw"]
        fields += [f"twist.twist.linear.{axis}" for axis in "xyz"]
        fields += [f"twist.twist.angular.{axis}" for axis in "xyz"]
        self._views = [template.view(path) for path in fields]

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
            t_ns: Sampling time [Unix ns].
            position: Centre of the head link in the world [m], shape (3,).
            quaternion: Its orientation, x, y, z, w, shape (4,).
            linear_velocity: In the head's frame [m/s], shape (3,).
            angular_velocity: In the head's frame [rad/s], shape (3,).
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.

        Raises:
            LogWriteError: If the file can't be written.
        """
        values = (*position, *quaternion, *linear_velocity, *angular_velocity)
        for view, value in zip(self._views, values, strict=True):
            view[0] = value
        self._emit(t_ns, log_time_ns)


class TransformChannel:
    """Poses of many frames."""

    def __init__(self, template: Template, count: int) -> None:
        """Wrap a template with ``count`` transforms."""
        self._template = template
        items = [f"transforms[{k}]" for k in range(count)]
        leaves = template.leaves
        self._stamps = [leaves[f"{item}.header.stamp.sec"].offset for item in items]
        poses = [f"{item}.transform" for item in items]
        self._offsets = [leaves[f"{pose}.translation.x"].offset for pose in poses]

    def write(
        self,
        t_ns: int,
        positions: FloatArray,
        quaternions: FloatArray,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """Write one sample of all frames.

        Args:
            t_ns: Sampling time [Unix ns].
            positions: [m], shape (k, 3).
            quaternions: x, y, z, w, shape (k, 4).
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.

        Raises:
            LogWriteError: If the file can't be written.
        """
        poses = np.concatenate([positions, quaternions], axis=1)
        rows = np.round(poses / _POSE_STEP) * _POSE_STEP
        for at, row in zip(self._offsets, rows, strict=True):
            self._template.message[at : at + 56] = row.astype("<f8").tobytes()
        self._template.emit(t_ns, log_time_ns, self._stamps)


class RangeChannel(_Stamped):
    """One number."""

    def __init__(self, template: Template, path: str) -> None:
        """Wrap a template; ``path`` names its number."""
        super().__init__(template)
        self._value = template.view(path)

    def write(self, t_ns: int, value: float, *, log_time_ns: int | None = None) -> None:
        """Write one sample.

        Args:
            t_ns: Sampling time [Unix ns].
            value: Distance [m]; +inf where nothing is in range (REP 117).
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.

        Raises:
            LogWriteError: If the file can't be written.
        """
        self._value[0] = value
        self._emit(t_ns, log_time_ns)


class VectorChannel(_Stamped):
    """One vector."""

    def __init__(self, template: Template, path: str) -> None:
        """Wrap a template; ``path`` names its vector."""
        super().__init__(template)
        self._axes = [template.view(f"{path}.{axis}") for axis in "xyz"]

    def write(self, t_ns: int, vector: FloatArray, *, log_time_ns: int | None = None) -> None:
        """Write one sample.

        Args:
            t_ns: Sampling time [Unix ns].
            vector: In the channel's unit, shape (3,).
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.

        Raises:
            LogWriteError: If the file can't be written.
        """
        for view, value in zip(self._axes, vector, strict=True):
            view[0] = value
        self._emit(t_ns, log_time_ns)


class ImuChannel(_Stamped):
    """Specific force and angular velocity."""

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        super().__init__(template)
        paths = [f"linear_acceleration.{axis}" for axis in "xyz"]
        paths += [f"angular_velocity.{axis}" for axis in "xyz"]
        self._views = [template.view(path) for path in paths]
        self._no_gyro = template.view("angular_velocity_covariance")

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
            t_ns: Sampling time [Unix ns].
            acceleration: Specific force in the sensor's frame [m/s^2], shape (3,).
            angular_velocity: [rad/s], shape (3,), or None where there is no gyroscope; marked so
                by a covariance of -1 (REP 145).
            log_time_ns: Time of recording [Unix ns]; the sampling time if None.

        Raises:
            LogWriteError: If the file can't be written.
        """
        gyro = np.zeros(3) if angular_velocity is None else angular_velocity
        self._no_gyro[0] = -1.0 if angular_velocity is None else 0.0
        for view, value in zip(self._views, (*acceleration, *gyro), strict=True):
            view[0] = value
        self._emit(t_ns, log_time_ns)


class StringChannel:
    """Text that changes now and then."""

    def __init__(self, send: Send) -> None:
        """Wrap what writes a message."""
        self._send = send

    def write(self, t_ns: int, text: str, *, log_time_ns: int | None = None) -> None:
        """Write one text.

        Args:
            t_ns: Time [Unix ns].
            log_time_ns: Time of recording [Unix ns]; the time itself if None.

        Raises:
            LogWriteError: If the file can't be written.
        """
        log_time = t_ns if log_time_ns is None else log_time_ns
        self._send(log_time, t_ns, encode(message_type("std_msgs/msg/String"), {"data": text}))


class LogChannel:
    """Events and faults."""

    def __init__(self, send: Send) -> None:
        """Wrap what writes a message."""
        self._send = send

    def write(
        self, t_ns: int, level: str, name: str, text: str, *, log_time_ns: int | None = None
    ) -> None:
        """Write one event.

        Args:
            t_ns: When it happened [Unix ns].
            level: ``debug``, ``info``, ``warn``, ``error`` or ``fatal``.
            name: Who says it, e.g. ``twin``.
            log_time_ns: Time of recording [Unix ns]; when it happened if None.

        Raises:
            DataError: If the level is none of these.
            LogWriteError: If the file can't be written.
        """
        if level not in _LEVELS:
            raise DataError(f"level {level!r} is none of {', '.join(_LEVELS)}")
        seconds, nanoseconds = divmod(t_ns, _NS)
        stamp = {"sec": seconds, "nanosec": nanoseconds}
        values = {"stamp": stamp, "level": _LEVELS[level], "name": name, "msg": text}
        log_time = t_ns if log_time_ns is None else log_time_ns
        self._send(log_time, t_ns, encode(message_type("rcl_interfaces/msg/Log"), values))


class FrameChannel:
    """Raw CAN frames of one kind, classic or CAN FD."""

    def __init__(self, send: Send, *, fd: bool = False) -> None:
        """Wrap what writes a message; ``fd``: the frames are CAN FD frames."""
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
            LogWriteError: If the file can't be written.
        """
        if frames.dtype != self._dtype:
            raise DataError(f"frames have the layout {frames.dtype}, not {self._dtype}")
        self._send(t_ns, t_ns, frame_message(frames, self._layout, self._dtype))


class TimeReferenceChannel:
    """A device's clock against the host's."""

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        self._template = template
        self._stamps = (template.leaves["header.stamp.sec"].offset,)
        self._reference = template.leaves["time_ref.sec"].offset

    def write(self, t_host_ns: int, t_device_ns: int, *, log_time_ns: int | None = None) -> None:
        """Write one pair of times.

        Args:
            t_host_ns: Host time [Unix ns].
            t_device_ns: The device's own time at that moment [ns since its own epoch]; 0 to
                2**31 s.
            log_time_ns: Time of recording [Unix ns]; the host time if None.

        Raises:
            DataError: If the message can't hold the device's time.
            LogWriteError: If the file can't be written.
        """
        try:
            _TIME.pack_into(self._template.message, self._reference, *divmod(t_device_ns, _NS))
        except struct.error as error:
            raise DataError(
                f"a device time of {t_device_ns} ns doesn't fit 32 bits of s"
            ) from error
        self._template.emit(t_host_ns, log_time_ns, self._stamps)


class DiagnosticsChannel:
    """The states of the recorder's components."""

    def __init__(self, send: Send) -> None:
        """Wrap what writes a message."""
        self._send = send

    def write(self, t_ns: int, statuses: Sequence[DiagnosticStatus]) -> None:
        """Write the states of one moment.

        Args:
            t_ns: When [Unix ns].

        Raises:
            LogWriteError: If the file can't be written.
        """
        seconds, nanoseconds = divmod(t_ns, _NS)
        values = {
            "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}},
            "status": [
                {
                    "level": status.level,
                    "name": status.name,
                    "message": status.message,
                    "hardware_id": status.hardware_id,
                    "values": [{"key": k, "value": v} for k, v in status.values.items()],
                }
                for status in statuses
            ],
        }
        self._send(t_ns, t_ns, encode(message_type("diagnostic_msgs/msg/DiagnosticArray"), values))
