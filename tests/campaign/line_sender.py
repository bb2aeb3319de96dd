"""The far end of a serial line: numbered packets of a servo; nothing of undulog is in it.

Arguments: path of the port, folder, bytes a second, fault, seconds, seed. The port is a
pseudo-terminal behind a link. ``sent`` in the folder has every byte that the kernel accepted,
``accepted`` two little-endian 64-bit numbers for each write: monotonic time, bytes so far.

Faults: ``noise`` between packets, ``stalls`` in and between them, ``vanishes``: the port is closed
and there is another later, after its bytes could be read.
"""

import os
import random
import select
import struct
import sys
import termios
import time
import tty
from pathlib import Path

SERVO, WRITE, GOAL = 1, 3, 42
READ_S = 0.5
"""Time in which a running reader has read all [s]: on a hang-up the kernel drops the rest."""


def packet(number):
    """A write of eight bytes to a servo: the number."""
    body = bytes([SERVO, 11, WRITE, GOAL]) + struct.pack("<Q", number)
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def opened(path):
    """Make the port; return its master, which never blocks, when a reader has it open."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    name = os.ttyname(slave)
    os.close(slave)  # a reader wants the port for itself
    new = path.with_suffix(".new")
    new.symlink_to(name)
    new.replace(path)
    until, before = time.monotonic() + 60, termios.tcgetattr(master)
    while is_alone(master) or termios.tcgetattr(master) == before:
        if time.monotonic() > until:
            sys.exit("nobody opened the port")
        time.sleep(0.01)
    time.sleep(READ_S)  # a reader sets the port, then drops what came before
    return master


def is_alone(master):
    """Whether nobody has the port open."""
    poll = select.poll()
    poll.register(master, select.POLLHUP)
    return bool(poll.poll(0))


def main():
    path, folder, rate, fault, seconds, seed = sys.argv[1:]
    path = Path(path)
    rate, seconds, rng = float(rate), float(seconds), random.Random(int(seed))
    with (
        open(f"{folder}/sent", "wb", buffering=0) as stream,  # noqa: PTH123
        open(f"{folder}/accepted", "wb", buffering=0) as log,  # noqa: PTH123
    ):
        master = opened(path)
        due_s, sent, number, rest = time.monotonic(), 0, 0, b""
        end_s, next_fault = due_s + seconds, due_s + rng.uniform(0.3, 1.5)
        while (now := time.monotonic()) < end_s:
            if now > next_fault:
                next_fault = now + rng.uniform(0.5, 1.5)
                if fault == "stalls":
                    time.sleep(rng.uniform(0.05, 0.5))
                elif fault == "vanishes" and not rest:
                    time.sleep(READ_S)
                    os.close(master)
                    time.sleep(rng.uniform(0.0, 0.5))
                    master = opened(path)
                due_s = time.monotonic()
            while due_s < time.monotonic():
                if is_alone(master):
                    return
                if not rest:
                    rest = packet(number)
                    number += 1
                    if fault == "noise" and rng.random() < 0.05:
                        rest += rng.randbytes(rng.randrange(1, 40))
                try:
                    count = os.write(master, rest[: rng.choice([len(rest), 3])])
                except BlockingIOError:  # the kernel's buffer is full
                    due_s = time.monotonic()
                    break
                stream.write(rest[:count])
                sent, rest, due_s = sent + count, rest[count:], due_s + count / rate
                log.write(struct.pack("<QQ", time.monotonic_ns(), sent))
            time.sleep(0.001)


if __name__ == "__main__":
    main()
