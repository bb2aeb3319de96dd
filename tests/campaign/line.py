"""A serial line that brings given bytes: the far end of a pseudo-terminal."""

import os
import threading
import tty
from pathlib import Path


def fed(work, data):
    """Run a function while a pseudo-terminal, ``line`` in the working folder, brings bytes."""
    master, slave = os.openpty()
    tty.setraw(slave)
    Path("line").symlink_to(os.ttyname(slave))
    threading.Thread(target=_write, args=(master, data), daemon=True).start()
    work()


def _write(master, data):
    rest = data
    while rest:  # as fast as the reader takes it; the process ends with the work
        rest = rest[os.write(master, rest[:1024]) :]
