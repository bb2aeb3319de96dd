"""The session writer: samples in, an MCAP file to the log contract out.

The file is finalised when the ``with`` block is left, however it is left.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.writer import Writer

from ..errors import DataError, LogWriteError, OutputExistsError
from ..robot import Robot
from .cdr import encode, layout_of
from .channels import (
    FrameChannel,
    ImuChannel,
    JointStateChannel,
    LogChannel,
    OdometryChannel,
    RangeChannel,
    Send,
    StringChannel,
    Template,
    TransformChannel,
    VectorChannel,
)
from .schemas import message_type, schema_text

CONTRACT_VERSION = "1"
"""Version of the log contract that this writer follows."""


class SessionWriter:
    """Writes one session file."""

    def __init__(
        self,
        path: Path | str,
        *,
        session_id: str,
        epoch_ns: int,
        robot: Robot | None = None,
        clock: Mapping[str, str] | None = None,
        metadata: Mapping[str, str] | None = None,
        force: bool = False,
    ) -> None:
        """Create the file and write what explains it.

        Args:
            path: The file to create.
            session_id: Names the session; the same for all its parts.
            epoch_ns: Unix time of the session's start [ns].
            robot: Its description travels as attachments ``robot.toml`` and its DBC files.
            clock: Source name to clock domain.
            metadata: Further facts, e.g. ``operator``; all values are strings.
            force: Replace an existing file.

        Raises:
            OutputExistsError: If the file is there and ``force`` is not given.
            LogWriteError: If it can't be created or written.
        """
        self.path = Path(path)
        self._epoch_ns = epoch_ns
        self._open = True
        self._stream = _create(self.path, force=force)
        self._writer = Writer(_Guarded(self._stream, self.path))  # pyright: ignore[reportArgumentType] a binary stream, as the writer uses it
        self._schemas: dict[str, int] = {}
        self._topics: set[str] = set()
        self._health: dict[str, str] = {}
        facts = {
            "session_id": session_id,
            "contract": CONTRACT_VERSION,
            "epoch_ns": str(epoch_ns),
            "robot": robot.name if robot is not None else "",
            "undulog": version("undulog"),
        }
        facts |= {f"clock.{source}": domain for source, domain in (clock or {}).items()}
        facts |= dict(metadata or {})
        self._writer.start(profile="ros2", library=f"undulog/{version('undulog')}")
        self._writer.add_metadata("undulog", facts)
        if robot is not None:
            self.attach("robot.toml", "application/toml", robot.toml.encode())
            for name, text in robot.databases:
                self.attach(name, "text/plain", text.encode())

    def __enter__(self) -> Self:
        """Nothing to do: the file is open."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finalise the file, also when the block is left by an exception."""
        self.close()

    # -- whole file ------------------------------------------------------------------------

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Store a file inside the session.

        Args:
            name: File name, e.g. ``scenario.toml``.
            media_type: Its media type, e.g. ``application/toml``.
            data: Its bytes.

        Raises:
            LogWriteError: If the file can't be written.
        """
        self._writer.add_attachment(self._epoch_ns, self._epoch_ns, name, media_type, data)

    def set_verdict(self, verdict: str, reasons: Sequence[str] = ()) -> None:
        """State the session's health, written when the file is closed.

        Args:
            verdict: ``good``, ``degraded`` or ``bad``.
            reasons: Why, one sentence each.
        """
        self._health = {"verdict": verdict, "reasons": json.dumps(list(reasons))}

    def close(self) -> None:
        """Write the summary and close; safe to call twice.

        Raises:
            LogWriteError: If the summary can't be written.
        """
        if not self._open:
            return
        self._open = False
        try:
            if self._health:
                self._writer.add_metadata("undulog.health", self._health)
            self._writer.finish()
            self._stream.flush()
        except OSError as error:
            with suppress(OSError):  # closing would say the same again
                self._stream.close()
            raise _write_error(self.path, error) from error
        self._stream.close()

    # -- channels --------------------------------------------------------------------------

    def joint_state(
        self,
        topic: str,
        names: Sequence[str],
        *,
        unit: str,
        velocity: bool = False,
        effort: bool = False,
    ) -> JointStateChannel:
        """Open a JointState channel.

        Args:
            topic: E.g. ``/joint_states``.
            names: Joint (or value) names, m of them, in chain order.
            unit: Unit of ``position``; kept in the channel's metadata.
            velocity: Whether samples carry velocities [rad/s].
            effort: Whether samples carry efforts [N m].

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        zeros = [0.0] * len(names)
        values: dict[str, Any] = {"name": list(names), "position": zeros}
        if velocity:
            values["velocity"] = zeros
        if effort:
            values["effort"] = zeros
        return JointStateChannel(
            self._template(topic, "sensor_msgs/msg/JointState", values, {"unit": unit})
        )

    def odometry(self, topic: str, *, frame: str, child: str) -> OdometryChannel:
        """Open an Odometry channel for the head's pose and velocity.

        Args:
            topic: E.g. ``/odom``.
            frame: Frame of the pose, e.g. ``world``.
            child: The moving link; the velocity is given in its frame.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        values = {"header": {"frame_id": frame}, "child_frame_id": child}
        return OdometryChannel(self._template(topic, "nav_msgs/msg/Odometry", values))

    def transforms(self, topic: str, *, parent: str, children: Sequence[str]) -> TransformChannel:
        """Open a TFMessage channel: poses of many frames, rounded to 2^-14, for viewers only.

        Args:
            topic: E.g. ``/tf``.
            parent: Frame of the poses.
            children: Names of the moving frames, k of them.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        header = {"frame_id": parent}
        items = [{"header": header, "child_frame_id": child} for child in children]
        return TransformChannel(
            self._template(topic, "tf2_msgs/msg/TFMessage", {"transforms": items}), len(children)
        )

    def range(
        self,
        topic: str,
        *,
        frame: str,
        min_range: float,
        max_range: float,
        field_of_view: float,
        infrared: bool = True,
    ) -> RangeChannel:
        """Open a Range channel (IR or sonar).

        Args:
            topic: E.g. ``/ir/01``.
            frame: The sensor's frame.
            min_range: Shortest distance it can tell [m].
            max_range: Longest distance it can tell [m].
            field_of_view: Full cone angle [rad].
            infrared: False for ultrasound.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        values = {
            "header": {"frame_id": frame},
            "radiation_type": int(infrared),
            "field_of_view": field_of_view,
            "min_range": min_range,
            "max_range": max_range,
        }
        return RangeChannel(
            self._template(topic, "sensor_msgs/msg/Range", values, {"unit": "m"}), "range"
        )

    def imu(self, topic: str, *, frame: str) -> ImuChannel:
        """Open an Imu channel; its orientation is marked as not estimated, as REP 145 has it.

        Args:
            topic: E.g. ``/imu``.
            frame: The sensor's frame.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        unknown = [-1.0] + [0.0] * 8
        values = {"header": {"frame_id": frame}, "orientation_covariance": unknown}
        return ImuChannel(self._template(topic, "sensor_msgs/msg/Imu", values))

    def magnetic_field(self, topic: str, *, frame: str) -> VectorChannel:
        """Open a MagneticField channel [T].

        Args:
            topic: E.g. ``/compass``.
            frame: The sensor's frame.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        values = {"header": {"frame_id": frame}}
        template = self._template(topic, "sensor_msgs/msg/MagneticField", values, {"unit": "T"})
        return VectorChannel(template, "magnetic_field")

    def string(self, topic: str) -> StringChannel:
        """Open a String channel.

        Args:
            topic: E.g. ``/gait/mode``.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        return StringChannel(self._sender(topic, "std_msgs/msg/String"))

    def log(self, topic: str = "/rosout") -> LogChannel:
        """Open a Log channel for events and faults.

        Args:
            topic: E.g. ``/rosout``.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        return LogChannel(self._sender(topic, "rcl_interfaces/msg/Log"))

    def frames(self, topic: str) -> FrameChannel:
        """Open a channel of raw CAN frames, many frames a message.

        Args:
            topic: E.g. ``/can/can0``.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        return FrameChannel(self._sender(topic, "std_msgs/msg/UInt8MultiArray"))

    # -- inside ----------------------------------------------------------------------------

    def _sender(
        self, topic: str, type_name: str, metadata: Mapping[str, str] | None = None
    ) -> Send:
        """Register a channel; returns what writes one message of it."""
        if topic in self._topics:
            raise DataError(f"{topic} is open already; a topic has one channel")
        self._topics.add(topic)
        if type_name not in self._schemas:
            text = schema_text(type_name).encode()
            self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text)
        channel_id = self._writer.register_channel(
            topic, "cdr", self._schemas[type_name], dict(metadata or {})
        )
        sequence = 0

        def send(log_time_ns: int, stamp_ns: int, data: bytes) -> None:
            nonlocal sequence
            if not self._open:
                raise LogWriteError(self.path, f"{topic}: the session is closed")
            self._writer.add_message(channel_id, log_time_ns, data, stamp_ns, sequence)
            sequence = (sequence + 1) & 0xFFFF_FFFF

        return send

    def _template(
        self,
        topic: str,
        type_name: str,
        values: Mapping[str, Any],
        metadata: Mapping[str, str] | None = None,
    ) -> Template:
        kind = message_type(type_name)
        example = encode(kind, values)
        leaves = layout_of(kind, example).leaves
        return Template(bytearray(example), leaves, self._sender(topic, type_name, metadata))


class _Guarded:
    """A binary stream whose failures name the file."""

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream, self._path = stream, path

    def write(self, data: bytes) -> int:
        try:
            return self._stream.write(data)
        except OSError as error:
            raise _write_error(self._path, error) from error

    def tell(self) -> int:
        return self._stream.tell()

    def flush(self) -> None:
        self._stream.flush()


def _write_error(path: Path, error: OSError) -> LogWriteError:
    if isinstance(error, LogWriteError):
        return error
    return LogWriteError(path, f"can't be written: {error.strerror or error}")


def _create(path: Path, *, force: bool) -> BinaryIO:
    try:
        return path.open("wb" if force else "xb")
    except FileExistsError as error:
        raise OutputExistsError(path) from error
    except OSError as error:
        raise _write_error(path, error) from error
