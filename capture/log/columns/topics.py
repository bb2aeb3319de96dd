"""The topics of an open log: their channels, message types, and the general decoder."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from mcap.exceptions import McapError
from mcap.records import Schema

from ...common.errors import DataError, MissingChannelError
from ..file.log_file import LogFile
from ..mcap.chunk import BODY_AT, LAST_NS, MESSAGE, PREFIX_SIZE
from ..messages.cdr import Layout
from ..messages.definitions import MessageType, parse_message_type
from .blocks import Window, blocks_in, record_batches
from .columns import Messages, Request, read_messages

_ENCODING, _SCHEMA_ENCODING = "cdr", "ros2msg"


@dataclass(frozen=True)
class Channel:
    """One topic of a session.

    Attributes:
        topic: E.g. ``/joint_states``.
        type_name: E.g. ``sensor_msgs/msg/JointState``.
        metadata: Of the channel, e.g. ``unit``.
        encoding: Of its messages, e.g. ``cdr``, ``json`` or ``protobuf``.
        schema_encoding: E.g. ``ros2msg``; empty without a schema.
    """

    topic: str
    type_name: str
    count: int
    metadata: Mapping[str, str]
    encoding: str
    schema_encoding: str

    @property
    def is_ros2(self) -> bool:
        """Whether its messages are of ROS 2 and can be read."""
        return (self.encoding, self.schema_encoding) == (_ENCODING, _SCHEMA_ENCODING)


def decoder_of(schema: Schema, where: str) -> Callable[[bytes], Any]:
    """Return the general decoder of a schema, for messages of any shape.

    Args:
        where: Begins the texts of errors.

    Returns:
        A function as :meth:`Topics.decoder` gives it.

    Raises:
        DataError: If the schema can't be used.
    """
    from mcap_ros2.decoder import DecoderFactory

    try:
        with redirect_stderr(StringIO()):  # its parser prints what it raises
            decode = cast("Any", DecoderFactory().decoder_for("cdr", schema))
    except Exception as error:  # the library's parser has no error tree of its own
        raise DataError(f"{where}: its schema can't be used: {error}") from error

    def checked(message: bytes) -> Any:
        try:
            return decode(message)
        except (McapError, struct.error, ValueError, IndexError, ArithmeticError) as error:
            raise DataError(f"{where}: a message is damaged: {error}") from error

    return checked


class Topics:
    """Reads topics of one file by name."""

    def __init__(self, log_file: LogFile, warn: Callable[[str], None], *, threads: int = 1) -> None:
        """Sort the file's channels by topic.

        Args:
            warn: Called with one sentence for each irregularity.
            threads: Number of decompressing threads.
        """
        self._file, self._threads, self._warn = log_file, threads, warn
        self._types: dict[int, MessageType | DataError] = {}  # by schema
        self._layouts: dict[str, dict[int, Layout]] = {}
        self._ids: dict[str, list[int]] = {}
        for channel in log_file.channels.values():
            self._ids.setdefault(channel.topic, []).append(channel.id)
        self.channels: Mapping[str, Channel] = MappingProxyType(
            {topic: self._channel(topic) for topic in self._ids}
        )

    def read(
        self, topics: Mapping[str, Sequence[str] | None], window_ns: Window
    ) -> dict[str, Messages]:
        """Read topics in one pass.

        Args:
            topics: Topic to leaf paths; None for all.
            window_ns: Half-open window of log times [Unix ns]; None for open ends.

        Raises:
            MissingChannelError: If the log has no such topic.
            DataError: If a topic's type can't be read, or one of JointStates has too many lists of
                joints.
        """
        requests = [
            Request(
                topic,
                self._channel_ids(topic),
                self.message_type(topic),
                paths,
                self._layouts.setdefault(topic, {}),
            )
            for topic, paths in topics.items()
        ]
        try:
            messages = read_messages(
                self._file, requests, window_ns=window_ns, warn=self._warn, threads=self._threads
            )
        except DataError as error:
            raise DataError(f"{self._file.path}: {error}") from None
        return dict(zip(topics, messages, strict=True))

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._file.path

    @property
    def is_ours(self) -> bool:
        """Whether undulog wrote the file, so that its log times are close to the stamps."""
        return self._file.library.startswith("undulog/")

    def message_type(self, topic: str) -> MessageType:
        """Return the type of a topic's messages.

        Raises:
            MissingChannelError: If the log has no such topic.
            DataError: If the schema can't be read.
        """
        schema = self._schema(topic)
        kind = self._types.get(schema.id)
        if kind is None:
            try:
                kind = parse_message_type(schema.name, schema.data.decode("utf-8", "replace"))
            except DataError as error:
                kind = error
            self._types[schema.id] = kind
        if isinstance(kind, DataError):
            raise DataError(str(kind))
        return kind

    def first(self, topic: str) -> tuple[int, bytes, MessageType] | None:
        """Return the first message of a topic: log time [Unix ns], bytes and type; None if empty.

        Raises:
            MissingChannelError: If the log has no such topic.
            DataError: If the topic's type can't be read.
        """
        kind = self.message_type(topic)
        for log_ns, message in self.raw(topic):
            return log_ns, message, kind
        return None

    def raw(self, topic: str, window_ns: Window = (None, None)) -> Iterator[tuple[int, bytes]]:
        """Yield the messages of a topic as bytes, in the order of the file.

        Args:
            window_ns: Half-open window of log times [Unix ns]; None for open ends.

        Yields:
            Log time [Unix ns] and the message's bytes.

        Raises:
            MissingChannelError: If the log has no such topic.
        """
        ids = self._channel_ids(topic)
        start_ns, stop_ns = window_ns
        # block by block, since often only the first is used
        for block in blocks_in(self._file, window_ns):
            for data, (records,) in record_batches(self._file, [ids], [block], self._warn):
                for at in records.offsets.tolist():
                    _, length, _, _, log_ns, _ = MESSAGE.unpack_from(data, at)
                    log_ns = min(log_ns, LAST_NS)
                    if (start_ns is None or log_ns >= start_ns) and (
                        stop_ns is None or log_ns < stop_ns
                    ):
                        yield log_ns, bytes(data[at + BODY_AT : at + PREFIX_SIZE + length])

    def raw_of(self, pending: set[str]) -> Iterator[tuple[str, bytes]]:
        """Yield the messages of several topics as bytes, each block decompressed once.

        Args:
            pending: The topics; one that is removed meanwhile yields no more, and none is the end.

        Yields:
            Topic and the message's bytes; those of one topic in the order of the file.
        """
        for block in blocks_in(self._file, (None, None)):
            names = [topic for topic in self._ids if topic in pending]
            if not names:
                return
            topic_ids = [self._ids[topic] for topic in names]
            for data, batch in record_batches(self._file, topic_ids, [block], self._warn):
                for topic, records in zip(names, batch, strict=True):
                    for at in records.offsets.tolist():
                        if topic not in pending:
                            break
                        _, length, *_ = MESSAGE.unpack_from(data, at)
                        yield topic, bytes(data[at + BODY_AT : at + PREFIX_SIZE + length])

    def decoder(self, topic: str) -> Callable[[bytes], Any]:
        """Return the general decoder of a topic, for messages of any shape.

        Returns:
            A function from bytes to a message with fields as attributes; it raises DataError for a
            damaged message.

        Raises:
            MissingChannelError: If the log has no such topic.
            DataError: If the topic's schema can't be used.
        """
        schema = self._schema(topic)
        self.message_type(topic)  # its error for a damaged schema is more precise
        return decoder_of(schema, f"{self._file.path}: {topic}")

    def _channel(self, topic: str) -> Channel:
        channels = [self._file.channels[channel_id] for channel_id in self._ids[topic]]
        types = [self._file.schemas.get(channel.schema_id) for channel in channels]
        names = [schema.name if schema is not None else "" for schema in types]
        if len(set(names)) > 1:
            self._warn(
                f"{topic} has several types, {', '.join(sorted(set(names)))}: {names[0]} is read"
            )
            self._ids[topic] = [
                channel.id
                for channel, name in zip(channels, names, strict=True)
                if name == names[0]
            ]
        count = sum(self._file.counts.get(channel_id, 0) for channel_id in self._ids[topic])
        return Channel(
            topic=topic,
            type_name=names[0],
            count=count,
            metadata=MappingProxyType(dict(channels[0].metadata)),
            encoding=channels[0].message_encoding,
            schema_encoding=types[0].encoding if types[0] is not None else "",
        )

    def _channel_ids(self, topic: str) -> list[int]:
        if topic not in self._ids:
            raise MissingChannelError(self._file.path, topic, sorted(self._ids))
        return self._ids[topic]

    def _schema(self, topic: str) -> Schema:
        channel = self._file.channels[self._channel_ids(topic)[0]]
        schema = self._file.schemas.get(channel.schema_id)
        if (
            schema is None
            or schema.encoding != _SCHEMA_ENCODING
            or channel.message_encoding != _ENCODING
        ):
            actual = f"{channel.message_encoding or 'no encoding'} with " + (
                f"a {schema.encoding or 'nameless'} schema" if schema is not None else "no schema"
            )
            raise DataError(
                f"{self._file.path}: {topic} is {actual}; only ROS 2 messages (cdr) are read"
            )
        return schema
