"""What a log holds, message by message, with its parts and its write-ahead log."""

from pathlib import Path

from undulog.capture.log.edit.raw_messages import RawLog


def read(path):
    """Return all messages of a log in the order they were written, and the reader's warnings."""
    with RawLog(Path(path)) as log:
        topics = {key: channel.topic for key, channel in log.file.channels.items()}
        found = [
            (topics[m.channel_id], m.sequence, m.log_time_ns, m.publish_time_ns, m.data)
            for m in log.messages(topics, 0, 1 << 64)
        ]
        return found, log.warnings
