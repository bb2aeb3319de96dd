"""rosbag2 recordings that are no single plain MCAP file: copied into a temporary one.

Bags of sqlite3, compressed bags and split bags are read by ``rosbags``. Message bytes and
definitions are copied as they are, one message at a time, so that one reader serves all logs.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import TYPE_CHECKING

from ...common.errors import LogError, MissingExtraError, NotALogError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

_PER_MESSAGE = re.compile(r"^\s*compression_mode:\s*['\"]?message\b", re.IGNORECASE | re.MULTILINE)
_COPY = "session.mcap"


def is_bag(path: Path) -> bool:
    """Whether a path is a rosbag2 recording that must be copied to be read."""
    if path.suffix == ".db3":
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
    """A bag's messages in a temporary MCAP file, which :meth:`close` removes."""

    def __init__(self, path: Path, folder: Path | None = None) -> None:
        """Copy a bag.

        Args:
            path: A rosbag2 folder or a ``.db3`` file.
            folder: Folder of the copy; None for the system's temporary one.

        Raises:
            MissingExtraError: If ``rosbags`` is not installed.
            NotALogError: If the bag is damaged or of an unknown kind.
            LogError: If the disk has no room for the copy.
        """
        try:
            from rosbags.rosbag2 import Reader
        except ImportError as error:
            raise MissingExtraError("reading a rosbag2 recording", "bags", "rosbags") from error
        _check_room(path, folder or Path(gettempdir()))
        self._folder = TemporaryDirectory(prefix="undulog-bag-", dir=folder)
        self.path = Path(self._folder.name, _COPY)
        try:
            with Reader(path) as bag:
                _copy(bag, self.path)
        except MemoryError:
            self.close()
            raise
        except Exception as error:  # rosbags lets sqlite's, zstd's and YAML's own errors through
            self.close()
            why = " ".join(str(error).split()) or type(error).__name__
            fix = "check metadata.yaml and the files it names, or run 'ros2 bag reindex'"
            raise NotALogError(
                path, f"can't be read as a rosbag2 recording: {why}; {fix}"
            ) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the copy."""
        self._folder.cleanup()


def _check_room(path: Path, folder: Path) -> None:
    files = [path] if path.is_file() else [each for each in path.iterdir() if each.is_file()]
    size = sum(each.stat().st_size for each in files)
    free = shutil.disk_usage(folder).free
    if free < size:
        why = f"its copy needs {size} bytes, {folder} has {free}; set TMPDIR to a larger disk"
        raise LogError(path, why)


def _copy(bag: Reader, target: Path) -> None:
    from mcap.writer import Writer

    with target.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="undulog")
        channels: dict[tuple[str, str], int] = {}
        for connection in bag.connections:
            encoding, text = _definition(connection)
            schema = writer.register_schema(connection.msgtype, encoding, text.encode())
            key = connection.topic, connection.msgtype
            channels[key] = writer.register_channel(connection.topic, "cdr", schema)
        for connection, t_ns, data in bag.messages():
            channel = channels[connection.topic, connection.msgtype]
            writer.add_message(channel, t_ns, bytes(data), t_ns)
        writer.finish()


def _definition(connection: Connection) -> tuple[str, str]:
    """Return encoding and text of a definition: the bag's own, else that of ROS 2."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_typestore

    stated = connection.msgdef
    if stated.format == MessageDefinitionFormat.MSG:
        return "ros2msg", stated.data
    if stated.format == MessageDefinitionFormat.IDL:
        return "ros2idl", stated.data
    known = get_typestore(Stores.LATEST)
    if connection.msgtype not in known.fielddefs:
        return "", ""  # kept raw
    return "ros2msg", known.generate_msgdef(connection.msgtype, ros_version=2)[0]
