"""Message definitions of bags: their own, those of ROS, and those of ros2_control by release.

Bags of sqlite3 up to ROS 2 Humble have no definitions. The types of ROS are the same in all
releases; the controller state of control_msgs has had five forms, of which the first message shows
the right one.

Source: https://github.com/ros-controls/control_msgs.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..messages.definitions import CONTROLLER_STATE, DYNAMIC_STATE

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

_HEADER = "std_msgs/msg/Header"
_INTERFACE = "control_msgs/msg/InterfaceValue"
_DYNAMIC = {
    DYNAMIC_STATE: (
        "std_msgs/Header header\nstring[] joint_names\n"
        "control_msgs/InterfaceValue[] interface_values\n"
    ),
    _INTERFACE: "string[] interface_names\nfloat64[] values\n",
}
_NEW, _OLD = ("reference", "feedback", "error", "output"), ("desired", "actual", "error")
_RELEASES = (
    ((*_NEW,), True, "float64 speed_scaling_factor\n"),  # 5.3 on: Jazzy, Rolling
    ((*_NEW,), True, ""),  # 5.0 to 5.2: Iron
    ((*_NEW, "desired", "actual"), True, ""),  # 4.1 on: Humble
    ((*_OLD,), True, ""),  # 3.0 to 4.0
    ((*_OLD,), False, ""),  # 1.0 to 2.5: Foxy, Galactic
)


def _controller_states() -> Iterator[str]:
    """Yield the forms of the controller state, the newest first."""
    point, multi = (
        "trajectory_msgs/JointTrajectoryPoint",
        "trajectory_msgs/MultiDOFJointTrajectoryPoint",
    )
    for parts, has_multi, last in _RELEASES:
        text = "std_msgs/Header header\nstring[] joint_names\n"
        text += "".join(f"{point} {part}\n" for part in parts)
        if has_multi:
            text += "string[] multi_dof_joint_names\n"
            text += "".join(f"{multi} multi_dof_{part}\n" for part in parts)
        yield text + last


def definition(connection: Connection, example: bytes | None) -> tuple[str, str]:
    """Return encoding and text of a definition: the bag's own, else a known one.

    Args:
        example: A message, which decides between several known ones.

    Returns:
        Schema encoding and text; both empty for an unknown type.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    stated = connection.msgdef
    if stated.format == MessageDefinitionFormat.MSG:
        return "ros2msg", stated.data
    if stated.format == MessageDefinitionFormat.IDL:
        return "ros2idl", stated.data
    kind = connection.msgtype
    forms = _controller_states() if kind == CONTROLLER_STATE else [_DYNAMIC.get(kind, "")]
    for text in forms:
        store = get_typestore(Stores.LATEST)
        if text:
            more = {name: each for name, each in _DYNAMIC.items() if name != kind}
            for name, each in {**more, kind: text}.items():
                store.register(get_types_from_msg(each, name))
        if kind in store.fielddefs and (kind != CONTROLLER_STATE or _fits(store, kind, example)):
            return "ros2msg", store.generate_msgdef(kind, ros_version=2)[0]
    return "", ""  # kept raw


def _fits(store: Typestore, kind: str, example: bytes | None) -> bool:
    """Whether a message is decoded to its last byte."""
    if example is None:
        return True
    store.max_sequence_length = max(1, len(example))
    try:
        store.deserialize_cdr(example, kind)
    except Exception:  # noqa: BLE001  its decoder has errors of many bases
        return False
    return True


class Ros1Types:
    """Converts the messages of a bag of ROS 1 to CDR."""

    def __init__(self, connections: list[Connection]) -> None:
        """Take the definitions of a bag."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._store = get_typestore(Stores.EMPTY)
        # The conversion leaves out the sequence number of a header, so that its type has none.
        header = "builtin_interfaces/Time stamp\nstring frame_id\n"
        self._store.register(get_types_from_msg(header, _HEADER))
        known: dict[str, str] = {}
        for one in connections:
            known.setdefault(one.msgtype, one.msgdef.data)
        for kind, text in known.items():
            types = get_types_from_msg(text, kind)
            self._store.register({name: each for name, each in types.items() if name != _HEADER})

    def definition(self, connection: Connection) -> tuple[str, str]:
        """Return the encoding and text of a type's definition in ROS 2."""
        return "ros2msg", self._store.generate_msgdef(connection.msgtype, ros_version=2)[0]

    def cdr(self, connection: Connection, message: bytes) -> bytes | None:
        """Return a message as CDR; None if it is damaged."""
        self._store.max_sequence_length = max(1, len(message))  # no element is without a byte
        try:
            return bytes(self._store.ros1_to_cdr(message, connection.msgtype))
        except Exception:  # noqa: BLE001  its decoder has errors of many bases
            return None
