"""Recordings of ROS that are no single plain MCAP file: copied into a temporary one.

Messages of ROS 2 and their definitions are copied as they are, those of ROS 1 converted by
``rosbags``, one message at a time, so that one reader serves all logs.

Bags of sqlite3 up to ROS 2 Humble have no definitions. The types of ROS are the same in all
releases; the controller state of control_msgs has had five forms, of which the first message shows
the right one (https://github.com/ros-controls/control_msgs).
"""

from __future__ import annotations

import errno
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from ...common.confined import Confined, size_of
from ...common.confined_child import Send
from ...common.errors import LogError, MissingExtraError, NotALogError, UndulogError
from ...common.extras import is_installed
from ...common.packets import Packet
from ..messages.definitions import CONTROLLER_STATE, DYNAMIC_STATE
from .bag_metadata import METADATA, Stated, is_rosbag2, metadata_text, read_stated
from .bag_parts import Allowance, opened
from .content import content_id_of

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

_PER_MESSAGE = re.compile(r"^\s*compression_mode:\s*['\"]?message\b", re.IGNORECASE | re.MULTILINE)
_COPY = "session.mcap"
_STEP = 4096
_ROS1 = ".bag"
_FILES = (".db3", _ROS1)
_RECORD_SIZE = 31
"""Of a message's record in an MCAP, without the message [byte]."""
_FULL = (errno.ENOSPC, errno.EDQUOT)
_WHAT = (
    (
        "a rosbag2 recording",
        "check metadata.yaml and the files it names, or run 'ros2 bag reindex'",
    ),
    ("a bag of ROS 1", "run 'rosbag reindex' or 'rosbag fix'"),
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
            more = {name: entry for name, entry in _DYNAMIC.items() if name != kind}
            for name, body in {**more, kind: text}.items():
                store.register(get_types_from_msg(body, name))
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
        texts: dict[str, str] = {}
        for connection in connections:
            texts.setdefault(connection.msgtype, connection.msgdef.data)
        for kind, text in texts.items():
            types = get_types_from_msg(text, kind)
            self._store.register(
                {name: fields for name, fields in types.items() if name != _HEADER}
            )

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


def is_bag(path: Path) -> bool:
    """Whether a path is a recording of ROS that must be copied to be read."""
    if not path.is_dir():
        return path.suffix in _FILES and path.is_file()
    if not is_rosbag2(path):
        return False
    stated = path / METADATA
    try:
        plain = len(list(path.glob("*.mcap"))) == 1
        return not plain or bool(_PER_MESSAGE.search(metadata_text(stated)))
    except OSError as error:
        raise LogError(stated, f"can't be read: {error.strerror}") from error


class BagCopy:
    """A bag's messages in a temporary MCAP file, which :meth:`close` removes.

    Attributes:
        warnings: What was left out, one sentence each.
        content: Id from the content of the bag.
    """

    def __init__(
        self,
        path: Path,
        folder: Path | None = None,
        on_part: Callable[[float], None] = lambda _: None,
    ) -> None:
        """Copy a bag.

        Args:
            path: A rosbag2 folder, a ``.db3`` file, or a ``.bag`` of ROS 1.
            folder: Folder of the copy; None for the system's temporary one.
            on_part: Called with the share that is done, 0 to 1; may raise an error of undulog.

        Raises:
            MissingExtraError: If ``rosbags`` is not installed.
            NotALogError: If the bag is damaged, of an unknown kind, or expands too far.
            LogError: If the disk has no room for the copy.
        """
        if not is_installed("rosbags"):
            raise MissingExtraError("reading a recording of ROS", "bags", "rosbags")
        scratch = folder or Path(tempfile.gettempdir())
        size = check_room(path, scratch)
        self._folder = tempfile.TemporaryDirectory(prefix="undulog-bag-", dir=folder)
        self.path = Path(self._folder.name, _COPY)
        reader = Confined(NotALogError)
        try:
            with closing(
                reader.stream(
                    f"{__name__}:parse", path, size=size, folder=self._folder.name,
                    scratch=str(scratch),
                )
            ) as packets:  # fmt: skip
                for packet in packets:
                    if "share" in packet.facts:
                        on_part(packet.facts["share"])
                    else:
                        self.content: str = packet.facts["content"]
                        self.warnings: list[str] = packet.facts["warnings"]
        except BaseException:
            self.close()
            raise
        finally:
            reader.close()

    def close(self) -> None:
        """Remove the copy."""
        self._folder.cleanup()


def parse(path: Path, send: Send, *, folder: str, scratch: str) -> None:
    """Copy a bag into a folder; runs in the child process.

    Args:
        scratch: The folder that the user knows.
    """
    from .bag_ros1 import BoundedReader

    tempfile.tempdir = folder
    ros1, size = path.suffix == _ROS1, size_of(path)

    def on_part(share: float) -> None:
        send(Packet({"share": share}))

    try:
        with Path(folder, _COPY).open("wb") as stream:
            copy = _Copy(path, stream, Allowance(path, size), on_part)
            if ros1:
                with BoundedReader(path, Allowance(path, size)) as bag:
                    types = Ros1Types(bag.connections)
                    read = ((way, t_ns, types.cdr(way, raw)) for way, t_ns, raw in bag.messages())
                    copy.add(bag.connections, bag.message_count, read, types.definition)
            else:
                copy.rosbag2(Path(folder, "part"), Allowance(path, size))
            copy.finish()
        content = content_id_of(copy.files)
    except (MemoryError, UndulogError):
        raise
    except Exception as error:
        # rosbags lets errors of struct, bz2 and dictionaries through
        if isinstance(error, OSError) and error.errno in _FULL:
            why = f"its copy fills {scratch}; choose a larger disk (TMPDIR)"
            raise LogError(path, why) from error
        why = " ".join(str(error).split()) or type(error).__name__
        kind, fix = _WHAT[ros1]
        raise NotALogError(path, f"can't be read as {kind}: {why}; {fix}") from error
    of = " of ROS 1" if ros1 else ""
    damaged = [
        f"{topic}: {count} messages{of} are damaged and left out"
        for topic, count in copy.damaged.items()
    ]
    send(Packet({"content": content, "warnings": [*copy.warnings, *damaged]}))


def check_room(path: Path, folder: Path) -> int:
    """Check that a folder's disk has room for as many bytes as a recording has.

    Returns:
        That number.

    Raises:
        LogError: If it has not.
    """
    from shutil import disk_usage

    size = size_of(path)
    free = disk_usage(folder).free
    if free < size:
        why = f"its copy needs {size} bytes, {folder} has {free}; choose a larger disk (TMPDIR)"
        raise LogError(path, why)
    return size


class _Copy:
    """The messages of a recording on their way into an MCAP file.

    Attributes:
        damaged: Number of messages that can't be read, by topic.
        warnings: Parts that can't be read.
        files: Of the recording.
    """

    def __init__(
        self, path: Path, stream: BinaryIO, allowance: Allowance, on_part: Callable[[float], None]
    ) -> None:
        from mcap.writer import Writer

        self._path, self._allowance, self._on_part = path, allowance, on_part
        self._writer = Writer(stream)
        self._writer.start(profile="ros2", library="undulog")
        self._channels: dict[tuple[str, str], int] = {}
        self._undescribed: dict[tuple[str, str], Connection] = {}
        self._begun, self._share = 0.0, 1.0
        self.damaged: Counter[str] = Counter()
        self.warnings: list[str] = []
        self.files = [path]

    def rosbag2(self, scratch: Path, allowance: Allowance) -> None:
        """Copy all files of a recording of ROS 2.

        Args:
            scratch: A name for a file decompressed.
            allowance: For what is decompressed.
        """
        path = self._path
        stated = read_stated(path) if path.is_dir() else Stated([path], "")
        self.files = stated.files
        self._share = 1 / len(self.files)
        for file in self.files:
            with opened(file, stated.mode, scratch, allowance) as part:
                self.add(part.connections, part.count, part.messages(), None)
                self.warnings += [text.replace(str(scratch), str(file)) for text in part.warnings]
            self._begun += self._share

    def add(
        self,
        connections: Iterable[Connection],
        total: int,
        messages: Iterable[tuple[Connection, int, bytes | None]],
        described: Callable[[Connection], tuple[str, str]] | None,
    ) -> None:
        """Add the messages of one file, and the topics without any.

        Args:
            total: Number of messages, for the progress.
            described: Gives encoding and text of a definition; None for those of ROS 2.
        """
        for count, (connection, t_ns, data) in enumerate(messages):
            if count % _STEP == 0:
                self._on_part(self._begun + self._share * min(1.0, count / max(total, 1)))
            if data is None:
                self.damaged[connection.topic] += 1
                continue
            self._allowance.take(len(data) + _RECORD_SIZE)
            channel = self._channel(connection, data, described)
            self._writer.add_message(channel, t_ns, data, t_ns)
        for connection in connections:
            if described is None:  # a later file may have a message, which shows its definition
                self._undescribed.setdefault((connection.topic, connection.msgtype), connection)
            else:
                self._channel(connection, None, described)

    def finish(self) -> None:
        """End the file.

        Raises:
            NotALogError: If the recording has no topics.
        """
        for connection in self._undescribed.values():
            self._channel(connection, None, None)
        if not self._channels:
            raise NotALogError(self._path, "holds no topics; record it again")
        self._writer.finish()

    def _channel(
        self,
        connection: Connection,
        example: bytes | None,
        described: Callable[[Connection], tuple[str, str]] | None,
    ) -> int:
        key = connection.topic, connection.msgtype
        if key not in self._channels:
            description = described(connection) if described else definition(connection, example)
            schema = self._writer.register_schema(
                connection.msgtype, description[0], description[1].encode()
            )
            encoding = getattr(connection.ext, "serialization_format", "cdr")
            self._channels[key] = self._writer.register_channel(connection.topic, encoding, schema)
        return self._channels[key]
