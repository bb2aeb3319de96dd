"""A saturated CAN bus in a process of its own: paced by the clock, never waiting for the recorder.

``python bench/bus_sender.py unix PATH`` connects to a recorder's SOCK_SEQPACKET source;
``python bench/bus_sender.py socketcand PORT`` is a socketcand server on loopback. The frames are
those of the shipped 25-joint snake in its polling cycle. What the receiver doesn't take at once
(EAGAIN) is dropped and counted, and so is every frame that is more than 20 ms behind its time. The
last line of the output is a JSON object of what was sent.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from measuring import wait_for

from undulog.capture import load_robot
from undulog.capture.common.strict_table import Faults
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX, FRAME_DTYPE, empty_frames
from undulog.capture.robot.bus_map import database_messages
from undulog.capture.robot.model import Direction

LATE_NS = 20_000_000
STEP_S = 0.002
PER_PACKET = 256
NS = 1_000_000_000


def cycle_frames() -> np.ndarray:
    """Return one polling cycle: each servo's command and answer, then the sensors."""
    robot = load_robot("snake25")
    assert robot.bus is not None
    messages = database_messages(dict(robot.databases), Faults()) or {}
    tx = {s.message for s in robot.bus.signals if s.direction is Direction.TX}
    names = [f"{joint}_{kind}" for joint in robot.joint_names for kind in ("command", "state")]
    names += [name for name in messages if name not in names]
    frames = empty_frames(len(names))
    frames["id_flags"] = [messages[name].frame_id for name in names]
    frames["dlc"] = [messages[name].length for name in names]
    frames["dir"] = [DIR_TX if name in tx else DIR_RX for name in names]
    return frames


def payloads(cycle: np.ndarray, first: int, count: int, rate: float, t0_ns: int) -> np.ndarray:
    """Return frames number ``first`` to ``first + count``: angles are sines, the rest a counter."""
    number = np.arange(first, first + count)
    frames = cycle[number % len(cycle)]
    t_s = number / rate
    angle = (2500 * np.sin(2 * np.pi * 0.5 * t_s - 0.5 * (number % len(cycle)))).astype("<i2")
    frames["t_device_ns"] = t0_ns + (number * (NS / rate)).astype(np.int64)
    frames["data"][:, :2] = angle[:, None].view(np.uint8)
    frames["data"][:, 2:4] = (number % 65536).astype("<u2")[:, None].view(np.uint8)
    used = np.arange(8) < frames["dlc"][:, None]
    frames["data"] *= used
    return frames


class UnixPeer:
    """Packets of up to 256 records, each with the running number of its first frame."""

    def __init__(self, path: str, *, per_packet: int, buffer: int) -> None:
        """Connect to a recorder that may still be starting; a buffer of 0 is the system's own."""
        self.per_packet = per_packet
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffer)  # cut to the limit
        wait_for(lambda: self.socket.connect_ex(path) == 0, 0.05)
        self.socket.setblocking(False)
        self.refused = 0

    def send(self, frames: np.ndarray, first: int, sent_ns: np.ndarray) -> int:
        """Offer frames; note when each was taken and return their number."""
        sent = 0
        for start in range(0, len(frames), self.per_packet):
            part = frames[start : start + self.per_packet]
            head = struct.pack("<QQ", first + start, self.refused)
            try:
                self.socket.send(head + part.tobytes())
            except BlockingIOError:
                self.refused += len(part)
                continue
            sent_ns[start : start + len(part)] = time.time_ns()
            sent += len(part)
        return sent

    def close(self) -> None:
        """Hang up."""
        self.socket.close()


class SocketcandPeer:
    """The server's end of the socketcand protocol in raw mode."""

    def __init__(self, port: int) -> None:
        """Serve one client; the first line of the output says on which port."""
        server = socket.create_server(("127.0.0.1", port))
        print(json.dumps({"port": server.getsockname()[1]}), flush=True)
        server.settimeout(60)
        self.socket, _ = server.accept()
        server.close()
        self.socket.settimeout(10)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.sendall(b"< hi >")
        text = b""
        while b"rawmode" not in text:
            got = self.socket.recv(4096)
            if not got:
                sys.exit("the client left during the greeting")
            text += got
            if b"open" in got or b"rawmode" in got:
                self.socket.sendall(b"< ok >")
            if b"rawmode" in got and b"open" in got:
                self.socket.sendall(b"< ok >")
        self.socket.setblocking(False)
        self.rest = b""
        self.refused = 0

    def send(self, frames: np.ndarray, first: int, sent_ns: np.ndarray) -> int:
        """Offer frames; returns how many were taken, the ones in our own buffer included.

        Those that stay in our buffer have no time: they leave with a later call.
        """
        del first
        if self.rest and not self._push():
            self.refused += len(frames)
            return 0
        text = [
            b"< frame %X %d.%06d %s >"
            % (i, t // NS, t % NS // 1000, bytes(d[:n]).hex(" ").encode())
            for i, t, n, d in zip(
                frames["id_flags"].tolist(),
                frames["t_device_ns"].tolist(),
                frames["dlc"].tolist(),
                frames["data"],
                strict=True,
            )
        ]
        self.rest = b"".join(text)
        if self._push():
            sent_ns[:] = time.time_ns()
        return len(frames)  # what is begun will be finished: a partial frame breaks the stream

    def _push(self) -> bool:
        with suppress(BlockingIOError):
            self.rest = self.rest[self.socket.send(self.rest) :]
        return not self.rest

    def close(self) -> None:
        """Hang up when the client has read everything; counts what it didn't."""
        deadline = time.monotonic() + 5
        while self.rest and time.monotonic() < deadline:
            select.select([], [self.socket], [], 0.1)
            self._push()
        if self.rest:
            self.refused += self.rest.count(b"<")
        self.socket.shutdown(socket.SHUT_WR)
        time.sleep(0.5)
        self.socket.close()


def main() -> None:
    """Send frames and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=["unix", "socketcand"])
    parser.add_argument("where")
    parser.add_argument("--rate", type=float, default=9000.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--per-packet", type=int, default=PER_PACKET)
    parser.add_argument("--buffer", type=int, default=1 << 20, help="SO_SNDBUF; 0: the default")
    parser.add_argument("--fifo", action="store_true", help="real-time priority")
    parser.add_argument("--sent", type=Path, help="npz of when each frame was taken")
    parser.add_argument("--log", type=Path, help="append each accepted batch: time, frames so far")
    parser.add_argument("--cycle", type=Path, help="npy of a polling cycle, known beforehand")
    args = parser.parse_args()
    if args.fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    elif os.geteuid() == 0:
        os.nice(-5)
    if args.kind == "unix":
        peer = UnixPeer(args.where, per_packet=args.per_packet, buffer=args.buffer)
    else:
        peer = SocketcandPeer(int(args.where))
    cycle = np.load(args.cycle) if args.cycle else cycle_frames()
    log = args.log.open("wb", buffering=0) if args.log else None
    begin = time.monotonic_ns() + 50_000_000
    wall = time.time_ns() + 50_000_000
    offered = accepted = late = worst_ns = 0
    total = round(args.rate * args.seconds)
    sent_ns = np.zeros(total, np.int64)
    while offered < total:
        time.sleep(STEP_S)
        now = time.monotonic_ns() - begin
        due = min(int(now * args.rate / NS) + 1, total)
        if due <= offered:
            continue
        frames = payloads(cycle, offered, due - offered, args.rate, wall)
        behind_ns = now - int(offered * NS / args.rate)
        worst_ns = max(worst_ns, behind_ns)
        if behind_ns > LATE_NS:
            late += max(0, min(len(frames), int((behind_ns - LATE_NS) * args.rate / NS)))
        accepted += peer.send(frames, offered, sent_ns[offered:due])
        offered = due
        if log is not None:
            log.write(struct.pack("<QQ", time.monotonic_ns(), accepted))
    peer.close()
    if args.sent is not None:
        np.savez(args.sent, sent_ns=sent_ns, t0_ns=wall, rate=args.rate)
    result = {
        "offered": offered,
        "accepted": accepted,
        "refused": peer.refused,
        "late": late,
        "worst_behind_ms": worst_ns * 1e-6,
        "record_size": FRAME_DTYPE.itemsize,
    }
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
