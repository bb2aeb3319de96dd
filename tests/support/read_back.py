"""Contents of a log: by our reader with its parts and its write-ahead log, or by mcap's reader."""

import struct
from pathlib import Path

from mcap.reader import make_reader
from mcap.stream_reader import MAGIC_SIZE
from mcap_ros2.decoder import DecoderFactory

from undulog.capture.log.edited_log import RawLog


def read(path):
    """Return all messages of a log in the order they were written, and the reader's warnings."""
    with RawLog(Path(path)) as log:
        topics = {key: channel.topic for key, channel in log.file.channels.items()}
        messages = [
            (topics[m.channel_id], m.sequence, m.log_time_ns, m.publish_time_ns, m.data)
            for m in log.messages(topics, 0, 1 << 64)
        ]
        return messages, log.warnings


def messages_of(path, **options):
    """Schema, channel and message of all messages of one file, by mcap's reader."""
    with path.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages(**options))


def opcodes_so_far(path):
    """The kinds of all whole records of a file that is still being written."""
    data, at, kinds = path.read_bytes(), MAGIC_SIZE, []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        at += 9 + length
        if at <= len(data):
            kinds.append(opcode)
    return kinds


def decoded_of(path, topics=None):
    """Topic, log time and content of all messages of one file, by mcap-ros2-support."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        rows = reader.iter_decoded_messages(topics)
        return [(channel.topic, message.log_time, content) for _, channel, message, content in rows]


def rows_of(path):
    """All messages of one file as :func:`read` has them, by mcap's reader."""
    return [
        (channel.topic, m.sequence, m.log_time, m.publish_time, m.data)
        for _, channel, m in messages_of(path)
    ]


def summary_of(path):
    with path.open("rb") as stream:
        return make_reader(stream).get_summary()


def metadata_of(path):
    """Metadata records of one file by name; records of one name are merged."""
    metadata = {}
    with path.open("rb") as stream:
        for record in make_reader(stream).iter_metadata():
            metadata.setdefault(record.name, {}).update(record.metadata)
    return metadata


def chunks_of(path, topic):
    """Chunk indexes of one file that list messages of a topic."""
    summary = summary_of(path)
    (key,) = (key for key, channel in summary.channels.items() if channel.topic == topic)
    return [
        chunk_index
        for chunk_index in summary.chunk_indexes
        if key in chunk_index.message_index_offsets
    ]
