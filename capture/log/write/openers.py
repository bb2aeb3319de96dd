"""How a session's channels are opened: one method for each kind of sample."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

from ..messages.cdr import encode, layout_of
from ..messages.schemas import message_type
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
from .recorder_channels import DiagnosticsChannel, TimeReferenceChannel


class ChannelOpeners(ABC):
    """Opens channels, at any time; a subclass says where their messages go."""

    def __init__(self) -> None:
        """Start without channels."""
        self._logs: dict[str, LogChannel] = {}

    @abstractmethod
    def _sender(
        self, topic: str, type_name: str, metadata: Mapping[str, str] | None = None
    ) -> Send:
        """Register a channel; returns what writes one message of it."""

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
        """Open a Log channel for events and faults; asked for again, it is the same one.

        Args:
            topic: E.g. ``/rosout``.

        Returns:
            The channel, shared by all that have events to tell.

        Raises:
            DataError: If the topic is open already with another type.
        """
        if topic not in self._logs:
            self._logs[topic] = LogChannel(self._sender(topic, "rcl_interfaces/msg/Log"))
        return self._logs[topic]

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

    def fd_frames(self, topic: str) -> FrameChannel:
        """Open a channel of raw CAN FD frames, many frames a message.

        Args:
            topic: E.g. ``/can_fd/can0``.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        return FrameChannel(self._sender(topic, "std_msgs/msg/UInt8MultiArray"), fd=True)

    def time_reference(self, topic: str, *, source: str) -> TimeReferenceChannel:
        """Open a TimeReference channel: a device's clock against the host's.

        Args:
            topic: E.g. ``/clock/can0``.
            source: Whose clock ``time_ref`` is on, e.g. ``can0``.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        values = {"source": source}
        return TimeReferenceChannel(self._template(topic, "sensor_msgs/msg/TimeReference", values))

    def diagnostics(self, topic: str = "/diagnostics") -> DiagnosticsChannel:
        """Open a DiagnosticArray channel: what the recorder says of itself.

        Args:
            topic: E.g. ``/diagnostics``.

        Returns:
            The channel.

        Raises:
            DataError: If the topic is open already.
        """
        return DiagnosticsChannel(self._sender(topic, "diagnostic_msgs/msg/DiagnosticArray"))

    # -- inside ----------------------------------------------------------------------------

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
