"""Cost of a frame: our sources against python-can's client of the same interface.

Each path gets the same frames from the same peer in the same run, ours and python-can's in turn, so
that the ratios count: a process that serves slcan over a pseudo-terminal, socketcand over TCP, or
packets over a Unix socket, at the rate of a busy bus, or with --rate 0 as fast as it is read. What
is counted is the reader's own processor time, its threads and the kernel's share included, for
ours with the polls in vain, for python-can with stamping the message and keeping it.

Run: python bench/sources.py [--frames 20000] [--runs 2] [--rate 8000]
"""

from __future__ import annotations

import contextlib
import importlib.util
import multiprocessing
import os
import select
import socket
import sys
import tempfile
import threading
import time
import tty
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np
from measuring import arguments
from records import compared, versions

from undulog.capture import SessionWriter
from undulog.capture.log.messages.frames import FRAME_DTYPE, empty_frames
from undulog.capture.sources.contract import SourceContext, open_source, parse_address
from undulog.sim.serve.socketcand_protocol import frame_text

TICK_S = 0.005
STREAM_S = 60.0


def traffic(count: int) -> np.ndarray[Any, np.dtype[np.void]]:
    """Return frames of eight bytes, as a robot's bus has them."""
    frames = empty_frames(count)
    number = np.arange(count, dtype=np.uint64)
    frames["t_device_ns"] = 1_700_000_000_000_000_000 + number * np.uint64(125_000)
    frames["id_flags"] = 0x100 + number % np.uint64(64)
    frames["dlc"] = 8
    frames["data"] = (number * np.uint64(0x9E3779B97F4A7C15))[:, None].view(np.uint8)
    return frames


def slcan_text(count: int) -> bytes:
    """Return the frames as an adapter sends them."""
    return b"".join(
        b"t%03X8%s\r" % (frame["id_flags"], bytes(frame["data"]).hex().upper().encode())
        for frame in traffic(count)
    )


def paced(data: bytes, count: int, rate: float) -> Iterator[bytes]:
    """Pieces of a stream of so many frames, at a rate [1/s]; 0 is without pause."""
    if not rate:
        yield data
        return
    begin, at = time.monotonic(), 0
    while at < len(data):
        due = min(len(data), int((time.monotonic() - begin) * rate / count * len(data)))
        if due > at:
            yield data[at:due]
        at = max(at, due)
        time.sleep(0.001)


def adapter(ready: Any, count: int, rate: float) -> None:
    """An slcan adapter that sends its frames once after each ``L`` or ``O``."""
    master, slave = os.openpty()
    tty.setraw(slave)
    ready.send(os.ttyname(slave))
    text, commands = slcan_text(count), b""
    while True:
        commands += os.read(master, 100)
        *given, commands = commands.split(b"\r")
        for command in given:
            if command:
                os.write(master, b"\r")
            if command in (b"L", b"O"):
                for piece in paced(text, count, rate):
                    left = piece
                    while left and not select.select([master], [], [], 0)[0]:
                        left = left[os.write(master, left[:2000]) :]
                    if left:
                        break  # told to close before the end


def server(ready: Any, count: int, rate: float) -> None:
    """A socketcand server that sends its frames to each client."""
    listener = socket.create_server(("127.0.0.1", 0))
    ready.send(listener.getsockname()[1])
    text = frame_text(traffic(count))
    while True:
        client, _ = listener.accept()
        client.sendall(b"< hi >")
        for _ in range(2):
            client.recv(100)
            client.sendall(b"< ok >")
        time.sleep(0.3)  # python-can can't bear frames right behind the answer
        with contextlib.suppress(OSError):
            for piece in paced(text, count, rate):
                client.sendall(piece)
            client.recv(1)
        client.close()


def sender(ready: Any, count: int, rate: float, path: str, per_packet: int) -> None:
    """A process that sends packets to a Unix socket."""
    packed = traffic(count).tobytes()
    size = per_packet * FRAME_DTYPE.itemsize
    ready.send(path)
    while True:
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            peer.connect(path)
            begin = time.monotonic()
            for start in range(0, len(packed), size):
                while rate and (time.monotonic() - begin) * rate * FRAME_DTYPE.itemsize < start:
                    time.sleep(0.0005)
                peer.send(packed[start : start + size])
        except OSError:
            time.sleep(0.02)
        peer.close()


@contextmanager
def process(target: Callable[..., None], *args: object) -> Iterator[Any]:
    """A peer in a process of its own; gives what it says first."""
    ours, theirs = multiprocessing.Pipe()
    child = multiprocessing.get_context("spawn").Process(target=target, args=(theirs, *args))
    child.start()
    try:
        yield ours.recv()
    finally:
        child.terminate()
        child.join()


def ours(address: str, count: int, context: SourceContext) -> float:
    """Return processor time a frame of one of our sources [us], polled each tick."""
    source = open_source(parse_address(address))
    source.start(context)
    got, start = 0, None
    deadline = time.monotonic() + STREAM_S
    while got < count and time.monotonic() < deadline:
        polled = source.poll()
        if start is None and polled.frames:
            start = time.process_time()
            skipped = sum(map(len, polled.frames))
        got += sum(map(len, polled.frames))
        time.sleep(TICK_S)
    spent = time.process_time() - (start or 0.0)
    source.stop()
    if got < count or start is None:
        raise SystemExit(f"{address}: {got} of {count} frames came")
    return spent / (got - skipped) * 1e6 if got > skipped else float("nan")


def theirs(count: int, **options: Any) -> float:
    """Return processor time a frame of python-can's client [us]: recv, stamp, keep."""
    bus = can.Bus(ignore_config=True, **options)
    kept: list[tuple[int, can.Message]] = []
    start = None
    deadline = time.monotonic() + STREAM_S
    while len(kept) < count and time.monotonic() < deadline:
        message = bus.recv(1.0)
        if message is not None:
            if start is None:
                start = time.process_time()
            kept.append((time.monotonic_ns(), message))
    spent = time.process_time() - (start or 0.0)
    bus.shutdown()
    if len(kept) < count:
        raise SystemExit(f"python-can: {len(kept)} of {count} frames came")
    return spent / (count - 1) * 1e6


def virtual(count: int, context: SourceContext) -> tuple[float, float]:
    """Processor time a frame over python-can's virtual bus [us]: our generic path, recv alone."""
    messages = [
        can.Message(arbitration_id=int(f["id_flags"]), is_extended_id=False, data=bytes(f["data"]))
        for f in traffic(count)
    ]
    figures: list[float] = []
    with can.Bus(interface="virtual", channel="bench", ignore_config=True) as bus:
        source = open_source(parse_address("can:virtual:bench"))
        source.start(context)
        source.poll()
        with can.Bus(interface="virtual", channel="bench", ignore_config=True) as alone:
            for message in messages:
                bus.send(message)
            start = time.process_time()
            got = 0
            while got < count:
                got += sum(map(len, source.poll().frames))
                time.sleep(TICK_S)
            figures.append((time.process_time() - start) / count * 1e6)
            source.stop()
            start = time.process_time()
            kept = [(time.monotonic_ns(), alone.recv(1.0)) for _ in range(count)]
            figures.append((time.process_time() - start) / len(kept) * 1e6)
    return figures[0], figures[1]


def main() -> None:
    """Measure and print a table."""
    given = arguments(__doc__, frames=20_000, runs=2, rate=8000.0).parse_args()
    count, rate = given.frames, given.rate
    can.set_logging_level("error")  # it warns of each message that two reads share
    rows: dict[str, list[tuple[float, float | None]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/frames.sock"
        epoch_ns = time.time_ns()
        with SessionWriter(Path(folder) / "s.mcap", session_id="s", epoch_ns=epoch_ns) as writer:
            context = SourceContext(time.time_ns, writer)
            has_serial = importlib.util.find_spec("serial") is not None
            with process(adapter, count, rate) as tty_path, process(server, count, rate) as port:
                slcan = {"interface": "slcan", "channel": tty_path, "sleep_after_open": 0.1}
                tcp = {"interface": "socketcand", "host": "127.0.0.1", "port": port}
                few = min(count, 5000)  # slcan of python-can is slow
                for _ in range(given.runs):
                    mine = ours(f"can:slcan:{tty_path}?bitrate=1000000", count, context)
                    other = theirs(few, **slcan) if has_serial else None
                    rows["slcan over a pty"].append((mine, other))
                    mine = ours(f"can:socketcand:can0?host=127.0.0.1&port={port}", count, context)
                    other = theirs(count, **tcp, channel="can0")
                    rows["socketcand over TCP"].append((mine, other))
                    rows["virtual (generic path)"].append(virtual(count, context))
            for per_packet in (1, 16, 256):
                with process(sender, count, rate, path, per_packet):
                    for _ in range(given.runs):
                        mine = ours(f"unix:{path}", count, context)
                        rows[f"unix, {per_packet} a packet"].append((mine, None))
    print(f"{'path':26}{'ours':>10}{'python-can':>14}   [us of processor time a frame, best run]")
    for name, figures in rows.items():
        mine = min(figure for figure, _ in figures)
        others = [figure for _, figure in figures if figure is not None]
        print(f"{name:26}{mine:10.2f}{f'{min(others):14.2f}' if others else '             -'}")
        if len(others) == len(figures):
            mine_of = [figure for figure, _ in figures]
            peer = versions("python-can")
            compared(f"take a frame, {name}", mine_of, others, peer, unit="us")
    print(f"python {sys.version.split()[0]}, {threading.active_count()} thread(s) left")


if __name__ == "__main__":
    main()
