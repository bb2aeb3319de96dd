"""Children that report numbers of 8 bytes on stdout and are killed."""

import os
import subprocess


def last_number(reported):
    """The last whole number that was reported."""
    whole = len(reported) // 8 * 8
    return int.from_bytes(reported[whole - 8 : whole], "little")


def killed_after(command, least):
    """Run a child, kill it as soon as it reports a number; return its last number."""
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        reported = b""
        try:
            while last_number(reported) < least:
                chunk = os.read(child.stdout.fileno(), 1 << 16)
                assert chunk, "the child has ended"
                reported += chunk
        finally:
            child.kill()
        while rest := os.read(child.stdout.fileno(), 1 << 16):
            reported += rest
    assert child.returncode == -9
    return last_number(reported)
