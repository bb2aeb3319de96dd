"""What an MCAP file holds besides its messages, and where those are."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from ...common.arrays import IntArray
from ...common.errors import LogError
from .chunk import PREFIX_SIZE, Block, Buffer, walk_records

_Record = TypeVar("_Record")


@dataclass
class McapContents:
    """What is known of an MCAP file; grows while its records are walked.

    Attributes:
        path: The file.
        profile: As its header has it, and so is ``library``.
        library: Who wrote it.
        schemas: By id.
        channels: By id.
        blocks: Where its messages are.
        counts: Channel id to number of messages.
        metadata: By name; records of one name are put together.
        attachments: By name, of several the last.
        appendices: Both, as stored; names may repeat.
        warnings: What could not be read, one sentence each.
        cut: Why the file was read record by record; empty where its summary told all.
    """

    path: Path
    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    blocks: list[Block] = field(default_factory=list[Block])
    counts: dict[int, int] = field(default_factory=dict[int, int])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    attachments: dict[str, Attachment] = field(default_factory=dict[str, Attachment])
    appendices: list[Attachment | Metadata] = field(default_factory=list["Attachment | Metadata"])
    warnings: list[str] = field(default_factory=list[str])
    cut: str = ""

    def take(self, opcode: int, data: Buffer, start: int, stop: int) -> None:
        """Note a record that reads alike in the data section, in a chunk and in the summary.

        Args:
            opcode: Its kind; others than those below are passed over.
            data: The bytes that it is in.
            start: Where its body begins.
            stop: One past its body's last byte.

        Raises:
            LogError: If it is damaged; mcap, struct and codecs raise errors of their own, too.
        """
        if opcode == Opcode.HEADER:
            header = self.parse(Header.read, data, start, stop)
            self.profile, self.library = header.profile, header.library
        elif opcode == Opcode.SCHEMA:
            schema = self.parse(Schema.read, data, start, stop)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = self.parse(Channel.read, data, start, stop)
            self.channels[channel.id] = channel
        elif opcode == Opcode.ATTACHMENT:
            attachment = self.parse(Attachment.read, data, start, stop)
            self.attachments[attachment.name] = attachment
            self.appendices.append(attachment)
        elif opcode == Opcode.METADATA:
            metadata = self.parse(Metadata.read, data, start, stop)
            self.metadata.setdefault(metadata.name, {}).update(metadata.metadata)
            self.appendices.append(metadata)

    def parse(
        self, read: Callable[[ReadDataStream], _Record], data: Buffer, start: int, stop: int
    ) -> _Record:
        """Read one record's body.

        Args:
            read: The reader of its kind.
            data: The bytes that it is in.
            start: Where its body begins.
            stop: One past its body's last byte.

        Returns:
            The record.

        Raises:
            LogError: If it claims more bytes than there is memory for.
        """
        try:
            return read(ReadDataStream(BytesIO(data[start:stop])))
        except OverflowError as error:  # a length beyond all memory
            raise LogError(self.path, f"the record at byte {start} is damaged") from error

    def walk(self, block: Block, data: Buffer, base: int) -> dict[int, IntArray]:
        """Walk a block without index; its schemas and channels are noted.

        Args:
            block: The block.
            data: The bytes that its payload is in.
            base: Where in them the payload begins.

        Returns:
            Channel id to the offsets of its messages in the payload.

        Raises:
            LogError: If a record is damaged; as for :meth:`take`.
        """
        found: dict[int, list[int]] = {}
        end = len(data) if block.compression else block.stop
        for opcode, start, stop in walk_records(data, base, end):
            if opcode == Opcode.MESSAGE:
                (channel_id,) = struct.unpack_from("<H", data, start)
                found.setdefault(channel_id, []).append(start - PREFIX_SIZE - base)
            else:
                self.take(opcode, data, start, stop)
        return {channel_id: np.array(at, dtype=np.int64) for channel_id, at in found.items()}

    def count(self, offsets: Mapping[int, IntArray]) -> None:
        """Count the messages of a block.

        Args:
            offsets: Of each channel's messages, by id.
        """
        for channel_id, at in offsets.items():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + len(at)
