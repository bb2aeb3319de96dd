"""Logs of several makes, and other readers of them, for the tests of edits."""

from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType

from support.foreign_logs import foreign_log
from support.read_back import messages_of
from undulog.capture.log.messages.cdr import encode
from undulog.capture.log.messages.definitions import message_type

EPOCH_NS = 1_700_000_000_000_000_000
MS = 1_000_000
STRING = "std_msgs/msg/String"
MAKES = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
    "uncompressed, no index": {"compression": CompressionType.NONE, "index_types": IndexType.NONE},
}


def text(value):
    return encode(message_type(STRING), {"data": value})


def write_log(path, messages, *, attachments=(), metadata=(), units=None, **options):
    """Write a foreign log of Strings: (topic, log time [ns after the epoch], text)."""
    with foreign_log(path, chunk_size=512, **options) as (writer, schema):
        for name, facts in metadata:
            writer.add_metadata(name, facts)
        for name, data in attachments:
            writer.add_attachment(11, 22, name, "text/plain", data)
        channels = {}
        for k, (topic, t_ns, content) in enumerate(messages):
            if topic not in channels:
                facts = {"unit": (units or {}).get(topic, ""), "made": "elsewhere"}
                channels[topic] = writer.register_channel(topic, "cdr", schema, facts)
            log_ns = EPOCH_NS + t_ns
            writer.add_message(channels[topic], log_ns, text(content), log_ns - 5, 7 * k)
    return path


def ticks(count=200, topics=("/a", "/b"), start_ms=0):
    return [
        (topics[k % len(topics)], (start_ms + 10 * k) * MS, f"word {k} " + "x" * (k % 30))
        for k in range(count)
    ]


def entry(schema, channel, message):
    return (
        message.log_time,
        channel.topic,
        message.publish_time,
        message.sequence,
        message.data,
        schema.name,
        schema.data,
        schema.encoding,
        channel.message_encoding,
        sorted(channel.metadata.items()),
    )


def read(path, **window):
    """Return every message by mcap's own reader, by log time."""
    return [entry(*item) for item in messages_of(path, **window)]


def in_file_order(path):
    return read(path, log_time_order=False)


def records(path):
    with path.open("rb") as stream:
        reader = make_reader(stream)
        stored = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = [
            (a.name, a.data, a.media_type, a.create_time, a.log_time)
            for a in reader.iter_attachments()
        ]
    return stored, attached


def between(messages, start_ms, stop_ms):
    low, high = EPOCH_NS + round(start_ms * MS), EPOCH_NS + round(stop_ms * MS)
    return [message for message in messages if low <= message[0] < high]
