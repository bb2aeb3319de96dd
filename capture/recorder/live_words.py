"""What explains a live feed's messages: kept, so that whoever comes can be told all of it."""

from __future__ import annotations

from mcap.records import Attachment, Channel, Metadata, Schema

from ..log.messages.frames import FRAME_TOPIC_PREFIXES
from ..log.sinks.sink import Description
from .live_wire import LiveMessage, pack_description, pack_message

_STREAMS = {
    "sensor_msgs/msg/JointState",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/Range",
    "sensor_msgs/msg/MagneticField",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/TimeReference",
}
"""Types whose messages are samples of something that goes on: fewer show the same."""

_STATES = {"std_msgs/msg/String"}
"""Types whose last message holds until the next: told to a relay that comes later."""

Queued = tuple[int, int, int, int, int, bytes]
"""The fields of a :class:`.capture.recorder.live_wire.LiveMessage`."""


class LiveWords:
    """Definitions, and the last messages of topics that speak only on change."""

    def __init__(self, *, period_ns: int, raw_frames: bool) -> None:
        """Know nothing yet.

        Args:
            period_ns: Least time between two messages of a channel of samples [ns].
            raw_frames: Whether raw frames, ``/can/...``, are shown.
        """
        self.periods: dict[int, int] = {}
        """Channels that are shown, and the least time between their messages [ns]; 0 for any."""
        self.states: dict[int, Queued | LiveMessage | None] = {}
        """Channels whose last message holds, and that message."""
        self._period_ns, self._raw_frames = period_ns, raw_frames
        self._schemas: dict[int, str] = {}
        self._packed: dict[tuple[str, object], bytes] = {}

    def pack(self, record: Description) -> bytes | None:
        """A definition as it is told, or None for one that isn't.

        Args:
            record: Of metadata only ``undulog`` is told, of attachments only the robot's
                description and its bus databases.

        Returns:
            A record of a datagram.
        """
        return None if _key(record) is None else pack_description(record)

    def keep(self, record: Description, packed: bytes) -> None:
        """Keep a definition that is told.

        Args:
            record: The definition; it replaces one of the same name or number.
            packed: The same, packed.
        """
        key = _key(record)
        if key is None:
            return
        self._packed[key] = packed
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel) and (
            self._raw_frames or not record.topic.startswith(FRAME_TOPIC_PREFIXES)
        ):
            kind = self._schemas.get(record.schema_id)
            self.periods[record.id] = self._period_ns if kind in _STREAMS else 0
            if kind in _STATES:
                self.states.setdefault(record.id, None)

    def groups(self, size: int) -> list[list[bytes]]:
        """All definitions and then the states that hold, in the order they are told.

        Args:
            size: Most bytes of a group, unless one record alone is longer.

        Returns:
            Records, a group a datagram.
        """
        states = [pack_message(state) for state in self.states.values() if state is not None]
        found: list[list[bytes]] = []
        filled = 0
        for packed in [*self._packed.values(), *(one for one in states if len(one) <= size)]:
            if not found or filled + len(packed) > size:
                found.append([])
                filled = 0
            found[-1].append(packed)
            filled += len(packed)
        return found


def _key(record: Description) -> tuple[str, object] | None:
    """What a definition replaces, or None for one that isn't told."""
    match record:
        case Schema():
            return "schema", record.id
        case Channel():
            return "channel", record.id
        case Attachment():
            name = record.name
            return ("file", name) if name == "robot.toml" or name.endswith(".dbc") else None
        case Metadata():
            return ("facts", record.name) if record.name == "undulog" else None
