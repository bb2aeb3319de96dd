"""Logs of CAN frames that are read in a child process: binary ones, by libraries that may crash."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..common.confined import Confined
from ..common.confined_child import Send
from ..common.errors import ImportFormatError
from ..common.extras import defer
from ..common.packets import Packet
from ..log.messages.frames import FD_FRAME_DTYPE
from .frame_log import FrameLog, LogBlock


def confined(opener: str) -> Callable[[Path], AbstractContextManager[FrameLog]]:
    """Return a function that opens a log in a child process.

    Args:
        opener: ``module:function``; called there with the path and a folder for temporary files, it
            gives the log as a context.
    """

    @contextmanager
    def open_log(path: Path) -> Generator[FrameLog]:
        parser = f"{__name__}:parse"
        with (
            TemporaryDirectory(prefix="undulog-") as scratch,
            closing(Confined(ImportFormatError)) as reader,
            closing(reader.stream(parser, path, opener=opener, scratch=scratch)) as packets,
        ):
            yield _received(packets)

    return open_log


def parse(path: Path, send: Send, *, opener: str, scratch: str) -> None:
    """Send the frames of a log; runs in the child process."""
    defer()
    module, _, function = opener.partition(":")
    with getattr(import_module(module), function)(path, Path(scratch)) as log:
        send(Packet(_facts(log)))
        for block in log.blocks:
            frames = block.frames.view(np.uint8).reshape(len(block), FD_FRAME_DTYPE.itemsize)
            arrays = {"frames": frames, "bus": block.bus, "is_fd": block.is_fd}
            send(Packet(_facts(log, block.done), arrays))
        send(Packet(_facts(log, 1.0)))


def _facts(log: FrameLog, done: float = 0.0) -> dict[str, Any]:
    kept = {"buses": log.buses, "problems": log.problems}
    return {**kept, "directions": log.directions, "time": log.time, "done": done}


def _received(packets: Iterator[Packet]) -> FrameLog:
    """Return the log whose facts and frames a child process sends."""
    first = next(packets).facts
    log = FrameLog(iter(()), [], bool(first["directions"]), first["time"], first["problems"])

    def blocks() -> Iterator[LogBlock]:
        for packet in packets:
            facts, arrays = packet.facts, packet.arrays
            log.buses[:], log.problems[:] = facts["buses"], facts["problems"]
            log.time = facts["time"]
            if arrays:
                frames = arrays["frames"].view(FD_FRAME_DTYPE).reshape(-1)
                yield LogBlock(frames, arrays["bus"], arrays["is_fd"], facts["done"])

    log.blocks = blocks()
    return log
