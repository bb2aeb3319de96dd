"""A client of the control socket: for the command line, and for controllers that tell their gait.

A controller keeps its connection::

    with ControlClient(path) as recorder:
        recorder.ask({"do": "gait", "values": {"horizontal.A": 0.4, "horizontal.omega": 3.1}})
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

from ..common.errors import ControlError

PATIENCE_S = 10.0
"""So long a client waits for a reply by default [s]: a recorder answers within a few ticks."""


class ControlClient:
    """One connection to a running recorder."""

    def __init__(self, path: Path, *, patience_s: float | None = PATIENCE_S) -> None:
        """Connect.

        Args:
            path: The control socket.
            patience_s: Longest wait for a reply [s]; None for ever.

        Raises:
            ControlError: If nobody listens there, or the socket is another user's.
        """
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(patience_s)
        self._buffer = bytearray()
        try:
            self._socket.connect(os.fspath(path))
        except (FileNotFoundError, ConnectionRefusedError) as error:
            self._socket.close()
            raise ControlError(f"{path}: no recorder listens there") from error
        except OSError as error:
            self._socket.close()
            raise ControlError(f"{path}: can't be reached: {error}") from error

    def __enter__(self) -> Self:
        """Nothing to do: it is connected."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect."""
        self.close()

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send one request and wait for its reply.

        Args:
            request: See :mod:`.capture.recorder.control_requests`.

        Returns:
            The reply without its ``ok``.

        Raises:
            ControlError: If the recorder refuses, doesn't answer in time, or ends before it has.
        """
        return self.ask_all([request])[0]

    def ask_all(self, requests: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Send several requests at once and wait for all replies: a recorder answers once a tick.

        Args:
            requests: See :mod:`.recorder.control_requests`; some 100 at most, so that neither
                side's buffer is full before the other one reads.

        Returns:
            The replies without their ``ok``, in order.

        Raises:
            ControlError: If the recorder refuses one, doesn't answer in time, or ends before.
        """
        lines = [json.dumps(request, allow_nan=False).encode() + b"\n" for request in requests]
        try:
            self._socket.sendall(b"".join(lines))
            while self._buffer.count(b"\n") < len(lines):
                data = self._socket.recv(65536)
                if not data:
                    raise ControlError(f"{self.path}: the recorder went before it had answered")
                self._buffer += data
        except TimeoutError as error:
            patience_s = self._socket.gettimeout()
            self.close()  # a late answer would pass for that to the next request
            raise ControlError(f"{self.path}: no answer in {patience_s:g} s") from error
        except OSError as error:
            raise ControlError(f"{self.path}: the recorder went: {error}") from error
        *answers, rest = bytes(self._buffer).split(b"\n", len(lines))
        self._buffer = bytearray(rest)
        replies = [self._read(answer) for answer in answers]
        for reply in replies:
            if not reply.pop("ok"):
                raise ControlError(str(reply.get("error", "refused")))
        return replies

    def _read(self, line: bytes) -> dict[str, Any]:
        """A reply, with its ``ok``."""
        try:
            reply = cast("dict[str, Any]", json.loads(line))
            reply["ok"] = bool(reply["ok"])
        except (ValueError, TypeError, KeyError) as error:
            raise ControlError(f"{self.path}: what answers there is no recorder") from error
        return reply

    def close(self) -> None:
        """Disconnect; safe to call twice."""
        self._socket.close()
