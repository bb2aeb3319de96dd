"""A listening Unix socket whose file appears only once it listens."""

from __future__ import annotations

import os
import secrets
import socket
from pathlib import Path


def listen_at(listener: socket.socket, path: Path, backlog: int) -> None:
    """Give a socket its name and listen; only its owner may connect.

    Between ``bind`` and ``listen`` a connection is refused, so the socket is bound under another
    name, and gets this one when it listens: a client that sees the file can connect.

    Args:
        listener: A stream or seqpacket socket, not bound.
        path: Where nothing is yet.
        backlog: How many may wait to be accepted.

    Raises:
        OSError: If something is at the path, or no socket can be made there.
    """
    os.fchmod(listener.fileno(), 0o600)  # before it has a name: no moment without
    # As long as the path itself, whose length is bounded (sun_path).
    length = len(os.fsencode(path.name))
    draft = path.with_name(("~" + secrets.token_hex(8)).ljust(length, "~")[:length])
    listener.bind(os.fspath(draft))
    try:
        listener.listen(backlog)
        path.hardlink_to(draft)
    finally:
        draft.unlink(missing_ok=True)
