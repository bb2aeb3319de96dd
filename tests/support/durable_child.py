"""A recorder for tests that kill it: run as a script, and imported for the truth.

It is no test module: a child process runs it, and each message can be told again from its number.
"""

import json
import os
import random
import signal
import struct
import sys

from mcap.records import Channel, Metadata, Schema

from undulog.capture.log.messages.definitions import schema_text
from undulog.capture.log.write.durable_sink import DurableSink

EPOCH_NS = 1_700_000_000_000_000_000
STRING = "std_msgs/msg/String"
TOPICS = ("/a", "/b", "/rare")


def message(number):
    """Return channel, sequence, log time, publish time and payload of a message by its number."""
    rng = random.Random(number)
    if number % 50 == 49:
        channel, sequence = 3, number // 50
    elif number % 2:
        channel, sequence = 2, number // 2 - number // 50
    else:
        channel, sequence = 1, number // 2
    text = rng.randbytes(rng.randrange(0, 300)).hex()
    payload = b"\0\1\0\0" + struct.pack("<I", len(text) + 1) + text.encode() + b"\0"
    log_ns = EPOCH_NS + number * 1_000_000
    return channel, sequence, log_ns, log_ns - 500, payload


_known = []


def truth(count):
    """Return all messages of a session, as a reader returns them."""
    for number in range(len(_known), count):
        channel, *rest = message(number)
        _known.append((TOPICS[channel - 1], *rest))
    return _known[:count]


def open_sink(path, **options):
    """Open a sink and define its channels."""
    sink = DurableSink(path, **options)
    define(sink)
    return sink


def define(sink):
    """Define the channels of the messages."""
    sink.define(Metadata("undulog", {"session_id": "killed", "epoch_ns": str(EPOCH_NS)}))
    sink.define(Schema(1, schema_text(STRING).encode(), "ros2msg", STRING))
    for key, topic in enumerate(TOPICS, start=1):
        sink.define(Channel(key, topic, "cdr", {}, 1))


def write(sink, number):
    """Write the message with that number."""
    channel, sequence, log_ns, publish_ns, payload = message(number)
    sink.write(channel, log_ns, publish_ns, sequence, payload)


def record(path, numbers, **options):
    """Write the messages with these numbers and close; returns the sink."""
    sink = open_sink(path, **options)
    for number in numbers:
        write(sink, number)
    sink.close(())
    return sink


def run(path, count=1 << 40, splits=(), split_every=0, close=False, **options):
    """Write messages, report each number after it was accepted, and kill the process.

    Args:
        path: The session.
        count: Messages; when the disk has what it can have of them, the process kills itself.
        splits: Numbers of messages after which a part begins.
        split_every: Messages of a part.
        close: Whether it is closed in good order instead, and the end told with a 0.
        options: Of the sink.
    """
    sink = open_sink(path, **options)
    for number in range(count):
        write(sink, number)
        os.write(1, (number + 1).to_bytes(8, "little"))
        if number + 1 in splits or (split_every and (number + 1) % split_every == 0):
            sink.split()
    if close:
        sink.close((Metadata("undulog.health", {"verdict": "good", "reasons": "[]"}),))
        os.write(1, bytes(8))
        return
    while sink.backlog:
        os.sched_yield()
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    run(sys.argv[1], **json.loads(sys.argv[2]))
