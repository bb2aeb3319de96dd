"""The standard streams of a command, in whatever state it was started.

A command that was started with a descriptor closed (``>&-``) would give that number to the next
file it opens, and what is printed, by itself or by a library, would go into a log. So missing
descriptors are opened on ``/dev/null`` before anything else is.
"""

from __future__ import annotations

import io
import os
import sys
from typing import TextIO

_STREAMS = ("stdin", "stdout", "stderr")
"""In the order of their descriptors."""


def prepare_streams() -> None:
    r"""Make all standard streams usable; the first step of a command.

    Output in an encoding that lacks a character has an escape in its place (``\u2026``).
    """
    _open_missing_descriptors()
    for number, name in enumerate(_STREAMS):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, _stream(number))
        elif number and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _open_missing_descriptors() -> None:
    for number in range(len(_STREAMS)):
        try:
            os.fstat(number)
        except OSError:
            # Opened in order, so this is the lowest number that is free.
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)  # as the three are by convention


def _stream(number: int) -> TextIO:
    """Return a stream on a descriptor."""
    mode = "w" if number else "r"
    return open(number, mode, encoding="utf-8", errors="backslashreplace", closefd=False)
