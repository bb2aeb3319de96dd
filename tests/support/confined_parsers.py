"""Parsers for the tests of child processes: what they are named after, they do."""

import ctypes
import os
import signal
import sys
from itertools import count
from pathlib import Path

import numpy as np

from undulog.capture.common.errors import MissingChannelError, MissingExtraError, NotALogError
from undulog.capture.common.packets import Packet


def shapes(path, send):
    table = np.arange(12.0).reshape(3, 4)
    facts = {"name": "joint\u202e\udc80", "path": str(path)}
    arrays = {"table": table, "turned": table.T, "back": table[::-1, ::2], "none": table[:0]}
    arrays |= {"bytes": np.arange(5, dtype="i1"), "day": np.array(["2024-02-29"], "M8[D]")}
    send(Packet(facts, arrays))


def process(path, send):
    send(Packet({"pid": os.getpid(), "path": sys.path, "cwd": str(Path.cwd())}))


def many(path, send, number):
    for k in range(number):
        send(Packet({"k": k}, {"x": np.full(1000, k)}))
        Path(path.parent, "sent").write_text(str(k + 1))


def crash(path, send):
    send(Packet({"begun": True}))
    ctypes.string_at(0)


def abort(path, send):
    os.abort()


def end(path, send):
    os._exit(0)


def fail(path, send):
    os.write(2, b"a library complains\n")
    print("a library talks")
    raise ZeroDivisionError("of a\nlibrary")


def no_log(path, send):
    raise NotALogError(path, "is no log")


def no_channel(path, send):
    raise MissingChannelError(path, "topic /x", ["/y"])


def no_extra(path, send):
    raise MissingExtraError("import", "parquet", "pyarrow")


def fill(path, send):
    kept = [np.ones(1 << 20) for _ in count()]
    send(Packet({"n": len(kept)}))


def wrapped(path, send):
    try:
        fill(path, send)
    except MemoryError as error:
        raise NotALogError(path, "can't be read") from error


def turn(path, send):
    while True:
        pass


def sleep(path, send):
    send(Packet({"pid": os.getpid()}))
    signal.pause()


def write(path, send, target, length):
    with Path(target).open("wb") as stream:
        stream.truncate(length)
    send(Packet())
