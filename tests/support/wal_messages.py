"""Messages that follow from their position, for the tests of the write-ahead log."""

import functools

from mcap.records import Channel

from undulog.capture.log.wal.writer import WriteAheadLog

CHANNEL = Channel(id=1, topic="/t", message_encoding="cdr", metadata={"unit": "rad"}, schema_id=1)
# The same in the children that get killed and here, so that each payload can be told again.
MESSAGE = """
import random

def message(position):
    size = random.Random(position).randrange(0, 700)
    payload = random.Random(-position).randbytes(size)
    return 1 + position % 3, 10**18 + position, 10**18 - position, position % 2**32, payload
"""
_space = {}
exec(MESSAGE, _space)
message = functools.cache(_space["message"])


def filled(folder, count, *, segment_size=4096):
    """Write and close a log with a number of messages, none released."""
    with WriteAheadLog(folder, segment_size=segment_size) as wal:
        for channel in (1, 2, 3):
            wal.define(Channel(channel, f"/{channel}", "cdr", {}, 0))
        for position in range(1, count + 1):
            assert wal.append(*message(position)) == position
    return folder


def check_messages(messages):
    """Check that every message is the one appended at its position, and that they are in order."""
    for item in messages:
        assert tuple(item[i] for i in (1, 3, 4, 2, 5)) == message(item.position)
    positions = [item.position for item in messages]
    assert positions == sorted(set(positions))
    return positions
