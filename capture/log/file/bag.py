"""Recordings of ROS that are no single plain MCAP file: copied into a temporary one.

Bags of sqlite3, compressed bags, split bags and bags of ROS 1 are read by ``rosbags``. Messages of
ROS 2 and their definitions are copied as they are, those of ROS 1 converted, one message at a time,
so that one reader serves all logs.
"""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import TYPE_CHECKING

from ...common.errors import LogError, MissingExtraError, NotALogError, UndulogError
from .bag_types import Ros1Types, definition

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader

_PER_MESSAGE = re.compile(r"^\s*compression_mode:\s*['\"]?message\b", re.IGNORECASE | re.MULTILINE)
_COPY = "session.mcap"
_STEP = 4096
_ROS1 = ".bag"
_FILES = (".db3", _ROS1)
_WHAT = (
    (
        "a rosbag2 recording",
        "check metadata.yaml and the files it names, or run 'ros2 bag reindex'",
    ),
    ("a bag of ROS 1", "run 'rosbag reindex' or 'rosbag fix'"),
)


def is_bag(path: Path) -> bool:
    """Whether a path is a recording of ROS that must be copied to be read."""
    if path.suffix in _FILES:
        return path.is_file()
    stated = path / "metadata.yaml"
    if not stated.is_file():
        return False
    try:
        plain = len(list(path.glob("*.mcap"))) == 1
        return not plain or bool(_PER_MESSAGE.search(stated.read_text(errors="replace")))
    except OSError as error:
        raise LogError(stated, f"can't be read: {error.strerror}") from error


class BagCopy:
    """A bag's messages in a temporary MCAP file, which :meth:`close` removes.

    Attributes:
        warnings: What was left out, one sentence each.
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
            NotALogError: If the bag is damaged or of an unknown kind.
            LogError: If the disk has no room for the copy.
        """
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader
        except ImportError as error:
            raise MissingExtraError("reading a recording of ROS", "bags", "rosbags") from error
        ros1 = path.suffix == _ROS1
        check_room(path, folder or Path(gettempdir()))
        self._folder = TemporaryDirectory(prefix="undulog-bag-", dir=folder)
        self.path = Path(self._folder.name, _COPY)
        try:
            with Reader1(path) if ros1 else Reader(path) as bag:
                damaged = _copy(bag, self.path, on_part)
        except (MemoryError, UndulogError):
            self.close()
            raise
        except Exception as error:  # rosbags lets sqlite's, zstd's and YAML's own errors through
            self.close()
            why = " ".join(str(error).split()) or type(error).__name__
            kind, fix = _WHAT[ros1]
            raise NotALogError(path, f"can't be read as {kind}: {why}; {fix}") from error
        except BaseException:
            self.close()
            raise
        self.warnings = [
            f"{topic}: {count} messages of ROS 1 are damaged and left out"
            for topic, count in damaged.items()
        ]

    def close(self) -> None:
        """Remove the copy."""
        self._folder.cleanup()


def check_room(path: Path, folder: Path) -> None:
    """Check that a folder's disk has room for as many bytes as a recording has.

    Raises:
        LogError: If it has not.
    """
    files = [path] if path.is_file() else [each for each in path.iterdir() if each.is_file()]
    size = sum(each.stat().st_size for each in files)
    free = shutil.disk_usage(folder).free
    if free < size:
        why = f"its copy needs {size} bytes, {folder} has {free}; choose a larger disk (TMPDIR)"
        raise LogError(path, why)


def _copy(bag: Reader | Reader1, target: Path, on_part: Callable[[float], None]) -> Counter[str]:
    """Copy all messages; return the number of damaged ones by topic."""
    from mcap.writer import Writer
    from rosbags.rosbag1 import Reader as Reader1

    damaged: Counter[str] = Counter()
    ros1 = Ros1Types(bag.connections) if isinstance(bag, Reader1) else None
    with target.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="undulog")
        channels: dict[tuple[str, str], int] = {}

        def channel_of(connection: Connection, example: bytes | None) -> int:
            key = connection.topic, connection.msgtype
            if key not in channels:
                found = ros1.definition(connection) if ros1 else definition(connection, example)
                schema = writer.register_schema(connection.msgtype, found[0], found[1].encode())
                channels[key] = writer.register_channel(connection.topic, "cdr", schema)
            return channels[key]

        total = max(bag.message_count, 1)
        for count, (connection, t_ns, raw) in enumerate(bag.messages()):
            if count % _STEP == 0:
                on_part(count / total)
            data = ros1.cdr(connection, bytes(raw)) if ros1 else bytes(raw)
            if data is None:
                damaged[connection.topic] += 1
                continue
            writer.add_message(channel_of(connection, data), t_ns, data, t_ns)
        for connection in bag.connections:
            channel_of(connection, None)
        writer.finish()
    return damaged
