"""A serial line on a pseudo-terminal: what is written at one end is read at the other, paced."""

import contextlib
import os
import tty
from functools import partial

from support.processes import pause, wait_for


class Line:
    """A pseudo-terminal; :meth:`send` writes at the pace of a baud rate."""

    def __init__(self, link, baud=1_000_000):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        tty.setraw(self.master)
        os.set_blocking(self.master, False)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.slave))
        self.byte_s = 10 / baud

    def send(self, data, most=64):
        """Write bytes, some at a time."""
        for at in range(0, len(data), most):
            part = data[at : at + most]
            pause(len(part) * self.byte_s)
            while part:
                part = part[wait_for(partial(self._write, part), "room in the line") :]

    def _write(self, part):
        with contextlib.suppress(BlockingIOError):
            return os.write(self.master, part)
        return 0

    def close(self):
        os.close(self.master)
        os.close(self.slave)


class Captured:
    """A port of the vendors' SDKs that keeps what is written and answers nothing."""

    def __init__(self):
        self.is_using = False
        self.written = b""

    def clearPort(self):  # noqa: N802
        """Nothing waits."""

    def writePort(self, packet):  # noqa: N802
        self.written += bytes(packet)
        return len(packet)

    def readPort(self, length):  # noqa: N802
        return b""

    def setPacketTimeout(self, length):  # noqa: N802
        """Answers never come."""

    def setPacketTimeoutMillis(self, msec):  # noqa: N802
        """Answers never come."""

    def isPacketTimeout(self):  # noqa: N802
        return True

    def take(self):
        taken, self.written = self.written, b""
        self.is_using = False
        return taken
