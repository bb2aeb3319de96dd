"""Sends frames of another process to a recorder, through the socket of a ``unix:`` source.

>>> sender = FrameSender("/run/user/1000/snake.sock")
>>> sender.send(frames)          # an array of FRAME_DTYPE; never waits
128

A process in another language does the same with 20 lines: connect an ``AF_UNIX`` socket of type
``SOCK_SEQPACKET`` and send packets as :mod:`.capture.sources.contract` describes them.
"""

from __future__ import annotations

import contextlib
import socket
import time
from pathlib import Path
from typing import Self

import numpy as np

from ..common.errors import DataError
from ..log.messages.frames import FRAME_DTYPE, FrameArray
from .contract import HEAD, MOST_RECORDS
from .receive_many import SO_SNDBUFFORCE, enlarge_buffer

_BUFFER_BYTES = 4 << 20
_PAUSE_S = 0.1


class FrameSender:
    """Sends frames to a recorder that may start later, be slow, and restart.

    Frames that are not accepted are not kept; their count is reported to the recorder.
    """

    def __init__(self, path: str | Path) -> None:
        """Set the path of the recorder; the first :meth:`send` connects."""
        self.path = Path(path)
        self.accepted = 0
        """Frames accepted, over all connections."""
        self.refused = 0
        """Frames not accepted: no recorder, or its buffer is full."""
        self._socket: socket.socket | None = None
        self._sequence = 0
        self._dropped = 0
        self._retry_at = 0.0

    @property
    def connected(self) -> bool:
        """Whether the last attempt to connect succeeded."""
        return self._socket is not None

    def send(self, frames: FrameArray) -> int:
        """Send frames, without waiting.

        Args:
            frames: Records of :data:`.FRAME_DTYPE`, shape (n,). ``t_device_ns``
                is the sampling time on the sender's own clock; ``t_host_ns`` is set on receipt.

        Returns:
            Number of accepted frames, from the first one on. The others are lost, and counted.

        Raises:
            DataError: If the array is of another type.
            OSError: If the socket can't be used at all, e.g. for want of permission.
        """
        if frames.dtype != FRAME_DTYPE or frames.ndim != 1:
            raise DataError(f"frames are records of 32 bytes, shape (n,); found {frames.dtype}")
        sock = self._connect()
        done = 0
        if sock is not None:
            payload = np.ascontiguousarray(frames)
            while done < len(frames):
                records = payload[done : done + MOST_RECORDS]
                if not self._put(sock, records.tobytes()):
                    break
                done += len(records)
                self._sequence += len(records)
            if self._socket is not None:
                self._sequence += len(frames) - done
                self._dropped += len(frames) - done
        self.accepted += done
        self.refused += len(frames) - done
        return done

    def close(self) -> None:
        """Report the last dropped frames, if possible, and disconnect; safe to call twice."""
        if self._socket is not None and self._dropped:
            self._put(self._socket, b"")
        self._disconnect()

    def __enter__(self) -> Self:
        """Return the sender; its first :meth:`send` connects."""
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.close()

    def _put(self, sock: socket.socket, records: bytes) -> bool:
        """Send one packet; return False if there is no room or no recorder."""
        try:
            sock.send(HEAD.pack(self._sequence, self._dropped) + records)
        except BlockingIOError:
            return False
        except (BrokenPipeError, ConnectionError):
            self._disconnect()
            return False
        return True

    def _connect(self) -> socket.socket | None:
        if self._socket is not None or time.monotonic() < self._retry_at:
            return self._socket
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            enlarge_buffer(sock, SO_SNDBUFFORCE, socket.SO_SNDBUF, _BUFFER_BYTES)
            sock.connect(str(self.path))
        except (FileNotFoundError, ConnectionRefusedError, BlockingIOError):
            sock.close()
            self._retry_at = time.monotonic() + _PAUSE_S
            return None
        except OSError:
            sock.close()
            raise
        self._socket, self._sequence, self._dropped = sock, 0, 0
        return sock

    def _disconnect(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None
            self._retry_at = time.monotonic() + _PAUSE_S
