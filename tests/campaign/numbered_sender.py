"""A server or a serial line with sequence numbers of its own; nothing of undulog is in it.

Arguments: kind (socketcand, reopened, slcan, serial), place, log, frames a second, seconds.
``socketcand`` and ``reopened`` serve one bus on a free port of the loopback and write the port to
the file ``place``; of a pseudo-terminal, ``place`` becomes a link to it. Each frame's data is its
number among those whose write returned; each is logged as two little-endian 64-bit numbers:
monotonic time, frames so far. Reports at the end, as JSON: accepted, and whether nobody listens any
more.
"""

import json
import os
import select
import socket
import struct
import sys
import time
import tty
from pathlib import Path

PATIENCE_S = 60.0


class Served:
    """A socketcand server of one bus, for one client after another."""

    def __init__(self, place):
        self.server = socket.create_server(("127.0.0.1", 0))
        part = Path(f"{place}.part")
        part.write_text(str(self.server.getsockname()[1]))
        part.rename(place)
        self.connections = 0

    def open(self):
        self.server.settimeout(PATIENCE_S)
        self.client = self.server.accept()[0]
        self.client.settimeout(PATIENCE_S)
        self.client.sendall(b"< hi >")
        for _ in range(2):
            if not self.client.recv(4096):
                raise ConnectionResetError
            self.client.sendall(b"< ok >")
        self.connections += 1

    def write(self, number):
        text = b"< frame 100 %d.%06d %s >" % (
            number // 1000,
            number % 1000,
            struct.pack("<Q", number).hex().encode(),
        )
        self.client.sendall(text)


class Reopened(Served):
    """The same, with a connection that ends after 2,000 frames and is accepted again."""

    def write(self, number):
        if number % 2000 == 1999:
            self.client.close()
            self.open()
        super().write(number)


class Terminal:
    """The far end of a pseudo-terminal, with blocking writes."""

    def __init__(self, place):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        tty.setraw(self.master)
        Path(place).symlink_to(os.ttyname(self.slave))
        self.connections = 0

    def put(self, data):
        while data:
            data = data[os.write(self.master, data) :]


class Slcan(Terminal):
    """An adapter."""

    def open(self):
        commands = b""
        until = time.monotonic() + PATIENCE_S
        while not commands.endswith((b"L\r", b"O\r")):
            if not select.select([self.master], [], [], until - time.monotonic())[0]:
                raise TimeoutError
            commands += os.read(self.master, 1)
            if commands.endswith(b"\r"):
                self.put(b"\r")
        self.connections += 1

    def write(self, number):
        self.put(b"t1008%s\r" % struct.pack("<Q", number).hex().upper().encode())


class Servos(Terminal):
    """A line of Feetech servos, whose packets carry the numbers."""

    def open(self):
        """Wait until somebody else has the port open."""
        until = time.monotonic() + PATIENCE_S
        name = os.ttyname(self.slave)
        os.close(self.slave)
        while not any(_has_open(process, name) for process in _others()):
            if time.monotonic() > until:
                raise TimeoutError
            time.sleep(0.05)
        time.sleep(0.3)  # it discards what came before
        self.connections += 1

    def write(self, number):
        body = struct.pack("<BBBQ", 7, 10, 0, number)
        self.put(b"\xff\xff" + body + bytes([~sum(body) & 255]))


def _others():
    return (p for p in Path("/proc").glob("[0-9]*") if int(p.name) != os.getpid())


def _has_open(process, name):
    try:
        return any(os.readlink(link) == name for link in (process / "fd").iterdir())  # noqa: PTH115
    except OSError:
        return False


KINDS = {"socketcand": Served, "reopened": Reopened, "slcan": Slcan, "serial": Servos}


def main():
    kind, place, log, rate, seconds = sys.argv[1:]
    rate, seconds = float(rate), float(seconds)
    line = KINDS[kind](place)
    line.open()
    began, accepted, turns = time.monotonic(), 0, 0
    ended = False
    with open(log, "wb", buffering=0) as kept:  # noqa: PTH123
        while not ended and (now := time.monotonic() - began) < seconds:
            for _ in range(int(now * rate) - turns):
                turns += 1
                try:
                    line.write(accepted)
                except OSError:  # the recorder has gone
                    ended = True
                    break
                accepted += 1
                kept.write(struct.pack("<QQ", time.monotonic_ns(), accepted))
            time.sleep(0.001)
    print(json.dumps({"accepted": accepted, "ended": ended}), flush=True)
    sys.stdin.read()  # a connection that ends is another fault


def never_late():
    """Be a line of hardware as far as this computer allows it: no other program holds one up.

    Servos' bytes that come late within a packet are a packet that was cut.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(2))
    except PermissionError:
        return


if __name__ == "__main__":
    never_late()
    main()
