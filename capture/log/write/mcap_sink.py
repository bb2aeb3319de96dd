"""A session file without a write-ahead log, for data that can be made again (twin, imports).

The topics that carry nearly all of a session's bytes have chunks of their own: reading ten seconds
of joint states decompresses nothing else, and messages of one type compress better side by side.
The other topics are small and share chunks.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol, TypeAlias

from mcap.records import Attachment, Channel, Metadata, Schema

from ...common.errors import DataError, LogWriteError, OutputExistsError
from ..mcap.batch import MessageBatch, MessageFields
from ..mcap.writer import Compression, McapWriter

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

_BULKY = frozenset(
    {"sensor_msgs/msg/JointState", "std_msgs/msg/UInt8MultiArray", "tf2_msgs/msg/TFMessage"}
)

PROFILE = "ros2"
"""MCAP profile of a log to the contract."""


Description: TypeAlias = Schema | Channel | Attachment | Metadata
"""Definitions, which come before the messages that need them."""


def chunk_group(topic: str, type_name: str) -> str:
    """Return the group of a channel: channels of one group share chunks.

    Args:
        type_name: Its message type, e.g. ``sensor_msgs/msg/Imu``.
    """
    return topic if type_name in _BULKY else ""


class MessageSink(Protocol):
    """Stores the records of a session writer, in order; called by one thread."""

    def define(self, record: Description) -> None:
        """Store a definition.

        Args:
            record: Schemas come before their channels, channels before their messages; the
                session writer numbers them from 1.

        Raises:
            LogWriteError: If it can't be stored.
        """

    def write(self, *message: *MessageFields) -> None:
        """Store one message.

        Args:
            log_time_ns: When it was recorded [Unix ns].
            publish_time_ns: When it was sampled [Unix ns].
            sequence: The channel's own counter.

        Raises:
            LogWriteError: If it can't be stored.
        """

    def write_batch(self, batch: MessageBatch) -> None:
        """Store messages, as one by one.

        Raises:
            LogWriteError: If one can't be stored; those before it are.
        """

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Finalise; safe to call twice.

        Args:
            last: Metadata for the end, e.g. the health verdict.

        Raises:
            LogWriteError: If it can't be finalised.
        """


class McapSink:
    """Writes one MCAP file; it is finalised by :meth:`close`."""

    def __init__(
        self,
        path: Path | str,
        *,
        force: bool = False,
        compression: Compression = 3,
        helpers: ThreadPoolExecutor | None = None,
    ) -> None:
        """Create the file.

        Args:
            compression: Level or parameters of zstd.
            helpers: Threads that compress, which outlive the sink; the caller's own if None.

        Raises:
            OutputExistsError: If the file exists and ``force`` is not given.
            LogWriteError: If it can't be created or written.
        """
        self.path = Path(path)
        self._open = True
        self._stream = create_file(self.path, force=force)
        guarded = _Guarded(self._stream, self.path)
        self._writer = McapWriter(
            guarded, group_of=chunk_group, compression=compression, helpers=helpers
        )
        self._writer.start(profile=PROFILE, library=library_name())

    def define(self, record: Description) -> None:
        """See :meth:`MessageSink.define`.

        Raises:
            DataError: If the id of a schema or channel is not the next one.
            LogWriteError: If the file can't be written.
        """
        write_description(self._writer, record)

    def write(self, *message: *MessageFields) -> None:
        """See :meth:`MessageSink.write`."""
        channel_id, log_time_ns, publish_time_ns, sequence, payload = message
        self._writer.add_message(channel_id, log_time_ns, payload, publish_time_ns, sequence)

    def write_batch(self, batch: MessageBatch) -> None:
        """See :meth:`MessageSink.write_batch`."""
        self._writer.add_batch(batch)

    def close(self, last: tuple[Metadata, ...]) -> None:
        """See :meth:`MessageSink.close`."""
        if not self._open:
            return
        self._open = False
        try:
            for record in last:
                write_description(self._writer, record)
            self._writer.finish()
            self._stream.flush()
        except OSError as error:
            with suppress(OSError):  # closing raises the same error
                self._stream.close()
            raise write_error(self.path, error) from error
        self._stream.close()


@cache
def own_version() -> str:
    """Return the version of this library."""
    return version("undulog")


def library_name() -> str:
    """Return the name and version of this library, for the header of a file."""
    return f"undulog/{own_version()}"


def write_description(writer: McapWriter, record: Description) -> None:
    """Write a definition.

    Raises:
        DataError: If the id of a schema or channel is not the next one: the library numbers them
            itself.
        LogWriteError: If the file can't be written.
    """
    match record:
        case Schema():
            given = writer.register_schema(record.name, record.encoding, record.data)
            _same_id(f"schema {record.name}", record.id, given)
        case Channel():
            given = writer.register_channel(
                record.topic, record.message_encoding, record.schema_id, dict(record.metadata)
            )
            _same_id(f"channel {record.topic}", record.id, given)
        case Attachment():
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        case Metadata():
            writer.add_metadata(record.name, dict(record.metadata))


def write_error(path: Path, error: OSError) -> LogWriteError:
    """Return a LogWriteError for an error of the operating system; keep one that is one."""
    if isinstance(error, LogWriteError):
        return error
    return LogWriteError(path, f"can't be written: {error.strerror or error}")


def create_file(path: Path, *, force: bool) -> BinaryIO:
    """Create a file to write.

    Raises:
        OutputExistsError: If it exists and ``force`` is not given.
        LogWriteError: If it can't be created.
    """
    try:
        return path.open("wb" if force else "xb")
    except FileExistsError as error:
        raise OutputExistsError(path) from error
    except OSError as error:
        raise write_error(path, error) from error


class _Guarded:
    """A binary stream whose failures name the file."""

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream, self._path = stream, path

    def write(self, data: bytes) -> int:
        try:
            return self._stream.write(data)
        except OSError as error:
            raise write_error(self._path, error) from error

    def tell(self) -> int:
        return self._stream.tell()

    def flush(self) -> None:
        self._stream.flush()


def _same_id(what: str, expected: int, given: int) -> None:
    if expected != given:
        raise DataError(f"{what} has the id {expected}; the next one is {given}")
