"""The session writer: writes samples as a log that follows the log contract.

A sink stores the records. Without one they go straight to an MCAP file, which is finalised when the
``with`` block is left, also by an exception.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ...common.errors import DataError, LogWriteError
from ...common.files import Closing
from ...robot.kinematics import mesh_type
from ...robot.model import Robot, Sensor, SensorKind
from ..mcap.batch import SEQUENCE_MASK, MessageBatch
from ..messages.cdr import encode, layout_of
from ..messages.definitions import CONTRACT_VERSION, message_type, schema_text
from .channels import (
    DiagnosticsChannel,
    FrameChannel,
    ImuChannel,
    JointStateChannel,
    LogChannel,
    MagneticFieldChannel,
    OdometryChannel,
    RangeChannel,
    Send,
    SendRows,
    StringChannel,
    Template,
    TimeReferenceChannel,
    TransformChannel,
)
from .mcap_sink import McapSink, MessageSink, own_version


class SessionWriter(Closing):
    """Writes one session.

    Example::

        start_ns = time.time_ns()
        with undulog.SessionWriter("own.mcap", session_id="1", epoch_ns=start_ns) as writer:
            states = writer.joint_state("/joint_states", ["head", "tail"], unit="rad")
            states.write(start_ns, [0.1, -0.1])
            states.write(start_ns + 10_000_000, [0.2, -0.2])

    A method that opens a channel raises DataError if its topic is open already; the channel may be
    opened at any time.
    """

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
        sink: MessageSink | None = None,
    ) -> None:
        """Open the session and write its metadata and the robot's description.

        Args:
            session_id: Names the session; the same for all its parts.
            epoch_ns: Unix time of the session's start [ns].
            robot: Stored as the attachment ``robot.toml`` with its DBC files and meshes.
            clock: Source name to clock domain.
            metadata: Further facts, e.g. ``operator``; all values are strings.
            sink: Stores the records and is closed with the session. With a sink, ``path`` only
                names the session in errors and ``force`` has no effect.

        Raises:
            OutputExistsError: If the file is there and ``force`` is not given.
            LogWriteError: If it can't be created or written.
        """
        self.path = Path(path)
        self._epoch_ns = epoch_ns
        self._open = True
        self._sink = McapSink(self.path, force=force) if sink is None else sink
        self._schemas: dict[str, int] = {}
        self._topics: set[str] = set()
        self._last: dict[str, Metadata] = {}
        self._logs: dict[str, LogChannel] = {}
        facts = {
            "session_id": session_id,
            "contract": str(CONTRACT_VERSION),
            "epoch_ns": str(epoch_ns),
            "robot": robot.name if robot is not None else "",
            "undulog": own_version(),
        }
        if robot is not None and robot.serial:
            facts["serial"] = robot.serial
        facts |= {f"clock.{source}": domain for source, domain in (clock or {}).items()}
        facts |= dict(metadata or {})
        self.note("undulog", facts)
        if robot is not None:
            self.attach("robot.toml", "application/toml", robot.toml.encode())
            for name, text in robot.databases:
                self.attach(name, "text/plain", text.encode())
            for name, data in robot.meshes:
                self.attach(name, mesh_type(name) or "application/octet-stream", data)

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
        """
        zeros = [0.0] * len(names)
        values = {
            "name": list(names),
            "position": zeros,
            "velocity": zeros if velocity else [],
            "effort": zeros if effort else [],
        }
        return JointStateChannel(
            self._template(topic, "sensor_msgs/msg/JointState", values, {"unit": unit})
        )

    def odometry(self, topic: str, *, frame: str, child: str) -> OdometryChannel:
        """Open an Odometry channel for the head's pose and velocity.

        Args:
            topic: E.g. ``/odom``.
            frame: Frame of the pose, e.g. ``world``.
            child: The moving link; the velocity is given in its frame.
        """
        values = {"header": {"frame_id": frame}, "child_frame_id": child}
        return OdometryChannel(self._template(topic, "nav_msgs/msg/Odometry", values))

    def transforms(self, topic: str, *, parent: str, children: Sequence[str]) -> TransformChannel:
        """Open a TFMessage channel: poses of many frames, rounded to 2^-14, for viewers only.

        Args:
            topic: E.g. ``/tf``.
            children: Names of the moving frames, k of them.
        """
        header = {"frame_id": parent}
        items = [{"header": header, "child_frame_id": child} for child in children]
        return TransformChannel(
            self._template(topic, "tf2_msgs/msg/TFMessage", {"transforms": items})
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
            min_range: Shortest distance that it measures [m].
            max_range: Longest distance that it measures [m].
            field_of_view: Full cone angle [rad].
        """
        values = {
            "header": {"frame_id": frame},
            "radiation_type": int(infrared),
            "field_of_view": field_of_view,
            "min_range": min_range,
            "max_range": max_range,
        }
        return RangeChannel(self._template(topic, "sensor_msgs/msg/Range", values, {"unit": "m"}))

    def imu(self, topic: str, *, frame: str) -> ImuChannel:
        """Open an Imu channel; its orientation is marked as not estimated, see REP 145.

        Args:
            topic: E.g. ``/imu``.
            frame: The sensor's frame.
        """
        values = {"header": {"frame_id": frame}, "orientation_covariance": ([-1.0] + [0.0] * 8)}
        return ImuChannel(self._template(topic, "sensor_msgs/msg/Imu", values))

    def magnetic_field(self, topic: str, *, frame: str) -> MagneticFieldChannel:
        """Open a MagneticField channel [T].

        Args:
            topic: E.g. ``/compass``.
            frame: The sensor's frame.
        """
        values = {"header": {"frame_id": frame}}
        template = self._template(topic, "sensor_msgs/msg/MagneticField", values, {"unit": "T"})
        return MagneticFieldChannel(template)

    def string(self, topic: str) -> StringChannel:
        """Open a String channel."""
        return StringChannel(self._sender(topic, "std_msgs/msg/String"))

    def log(self, topic: str = "/rosout") -> LogChannel:
        """Open a Log channel for events and faults, or return the open one."""
        if topic not in self._logs:
            self._logs[topic] = LogChannel(self._sender(topic, "rcl_interfaces/msg/Log"))
        return self._logs[topic]

    def frames(self, topic: str) -> FrameChannel:
        """Open a channel of raw CAN frames, many frames a message.

        Args:
            topic: E.g. ``/can/can0``.
        """
        return FrameChannel(self._sender(topic, "std_msgs/msg/UInt8MultiArray"))

    def fd_frames(self, topic: str) -> FrameChannel:
        """Open a channel of raw CAN FD frames, many frames a message.

        Args:
            topic: E.g. ``/can_fd/can0``.
        """
        return FrameChannel(self._sender(topic, "std_msgs/msg/UInt8MultiArray"), fd=True)

    def time_reference(self, topic: str, *, source: str) -> TimeReferenceChannel:
        """Open a TimeReference channel: a device's clock against the host's.

        Args:
            topic: E.g. ``/clock/can0``.
            source: Whose clock ``time_ref`` is on, e.g. ``can0``.
        """
        values = {"source": source}
        return TimeReferenceChannel(self._template(topic, "sensor_msgs/msg/TimeReference", values))

    def diagnostics(self, topic: str = "/diagnostics") -> DiagnosticsChannel:
        """Open a DiagnosticArray channel for the states of the recorder's components."""
        return DiagnosticsChannel(self._sender(topic, "diagnostic_msgs/msg/DiagnosticArray"))

    def messages(
        self, topic: str, type_name: str, metadata: Mapping[str, str] | None = None
    ) -> Send:
        """Open a channel of messages that are encoded already.

        Args:
            type_name: One of the log contract's types.

        Returns:
            A function of log time [Unix ns], publish time [Unix ns] and the message.
        """
        return self._sender(topic, type_name, metadata)

    # -- whole session ---------------------------------------------------------------------

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Store a file inside the session.

        Args:
            name: File name, e.g. ``scenario.toml``.
            media_type: Its media type, e.g. ``application/toml``.

        Raises:
            LogWriteError: If the session can't be written.
        """
        self._sink.define(Attachment(self._epoch_ns, self._epoch_ns, name, media_type, data))

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """Write a metadata record now; a reader merges records of one name.

        Raises:
            LogWriteError: If the session can't be written.
        """
        self._sink.define(Metadata(name, dict(facts)))

    def explain(self, texts: Mapping[str, bytes], records: Mapping[str, Mapping[str, str]]) -> None:
        """Store the inputs of a session.

        Args:
            texts: File name to TOML text, e.g. ``plan.toml``.
            records: Metadata records by name.

        Raises:
            LogWriteError: If the session can't be written.
        """
        for name, text in texts.items():
            self.attach(name, "application/toml", text)
        for name, facts in records.items():
            self.note(name, facts)

    def note_at_end(self, name: str, facts: Mapping[str, str]) -> None:
        """Keep a metadata record until the session is closed.

        Args:
            name: Its name, e.g. ``undulog.clock``; another one of that name is replaced.
        """
        self._last[name] = Metadata(name, dict(facts))

    def set_verdict(self, verdict: str, reasons: Sequence[str] = ()) -> None:
        """State the session's health, written when it is closed.

        Args:
            verdict: ``good``, ``degraded`` or ``bad``.
            reasons: Why, one sentence each.
        """
        self.note_at_end(
            "undulog.health", {"verdict": verdict, "reasons": json.dumps(list(reasons))}
        )

    def close(self) -> None:
        """Finalise; safe to call twice.

        Raises:
            LogWriteError: If the summary can't be written.
        """
        if not self._open:
            return
        self._open = False
        self._sink.close(tuple(self._last.values()))

    # -- inside ----------------------------------------------------------------------------

    def _sender(
        self, topic: str, type_name: str, metadata: Mapping[str, str] | None = None
    ) -> Send:
        """Register a channel and return the function that writes one message."""
        return self._senders(topic, type_name, metadata)[0]

    def _senders(
        self, topic: str, type_name: str, metadata: Mapping[str, str] | None = None
    ) -> tuple[Send, SendRows]:
        """Register a channel; return the functions that write one message, and many of one size."""
        if topic in self._topics:
            raise DataError(f"{topic} is open already; a topic has one channel")
        if type_name not in self._schemas:
            schema_id = len(self._schemas) + 1
            text = schema_text(type_name).encode()
            self._sink.define(Schema(schema_id, text, "ros2msg", type_name))
            self._schemas[type_name] = schema_id
        channel_id = len(self._topics) + 1
        schema_id = self._schemas[type_name]
        self._sink.define(Channel(channel_id, topic, "cdr", dict(metadata or {}), schema_id))
        self._topics.add(topic)
        sequence = 0
        sink = self._sink
        write = sink.write

        def send(log_time_ns: int, stamp_ns: int, data: bytes) -> None:
            nonlocal sequence
            if not self._open:
                raise LogWriteError(self.path, f"{topic}: the session is closed")
            write(channel_id, log_time_ns, stamp_ns, sequence, data)
            sequence = (sequence + 1) & SEQUENCE_MASK

        def send_rows(log_ns: IntArray, t_ns: IntArray, records: NDArray[np.uint8]) -> None:
            nonlocal sequence
            if not self._open:
                raise LogWriteError(self.path, f"{topic}: the session is closed")
            batch = MessageBatch(channel_id, log_ns, t_ns, sequence, records)
            sequence = (sequence + len(t_ns)) & SEQUENCE_MASK  # also if some are not accepted
            sink.write_batch(batch)

        return send, send_rows

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
        return Template(bytearray(example), leaves, *self._senders(topic, type_name, metadata))


def open_sensor(
    writer: SessionWriter, sensor: Sensor
) -> ImuChannel | MagneticFieldChannel | RangeChannel:
    """Open a sensor's channel on the topic of its description; its frame has its name.

    Raises:
        DataError: If the topic is open already.
    """
    if sensor.kind is SensorKind.ACCELEROMETER:
        return writer.imu(sensor.topic, frame=sensor.name)
    if sensor.kind is SensorKind.COMPASS:
        return writer.magnetic_field(sensor.topic, frame=sensor.name)
    return writer.range(
        sensor.topic,
        frame=sensor.name,
        min_range=sensor.range_min or 0.0,
        max_range=sensor.range_max or 0.0,
        field_of_view=sensor.field_of_view or 0.0,
        infrared=sensor.kind is SensorKind.IR,
    )
