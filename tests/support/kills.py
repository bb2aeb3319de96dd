"""Children that report numbers of 8 bytes on stdout and are killed."""

import os
import select
import subprocess
import time


def last_number(reported):
    """The last whole number that was reported."""
    whole = len(reported) // 8 * 8
    return int.from_bytes(reported[whole - 8 : whole], "little")


def killed_after(command, seconds):
    """Run a child, kill it that long after its first report, and return its last number."""
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        try:
            pipe = child.stdout.fileno()
            reported = os.read(pipe, 1 << 16)
            deadline = time.monotonic() + seconds
            while (left := deadline - time.monotonic()) > 0:
                if select.select([pipe], [], [], left)[0]:
                    reported += os.read(pipe, 1 << 16)
        finally:
            child.kill()
        while rest := os.read(pipe, 1 << 16):
            reported += rest
    assert child.returncode == -9
    assert reported, "the child did not start"
    return last_number(reported)
