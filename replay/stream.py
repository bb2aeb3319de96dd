"""Rerun's recording streams, with limits, and their way into a file.

Rerun's own file sink ends its thread at a failed write, and whoever sends to that thread then may
wait for ever. So its sink is a pipe, which a thread of ours empties into the file: a failed write
is an error here, and the pipe is emptied even then, so that Rerun never waits for a disk.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import rerun as rr
from rerun.chunk import LazyChunkStream

from undulog.capture.common.errors import LogWriteError, NoAnswerError
from undulog.capture.common.files import Closing
from undulog.capture.common.waits import LIMIT_S, Standstill, attended

_PIPE = 1 << 20  # bytes; the most that Linux allows without privileges
_SYNC = 32 << 20  # bytes from one fsync to the next, so that a slow disk shows progress
_LOOK_S = 0.02
_OVER_S = 5.0  # beyond Rerun's own limit of a flush, which parts of it don't keep
_WHAT = "Rerun's recording stream"
_ADVICE = "nothing is lost, since the session is unchanged; start the command again"


class BoundedStream(rr.RecordingStream):
    """A recording stream whose flush and end have a limit.

    Attributes:
        progress: Returns anything that changes when data leave the stream.
        look: Called while a flush is waited for and after it; may raise to end the wait.
    """

    progress: Callable[[], object] = staticmethod(lambda: None)
    look: Callable[[], None] = staticmethod(lambda: None)

    def flush(self, *, timeout_sec: float | None = None) -> None:
        """Wait until all data have left the stream.

        Args:
            timeout_sec: Rerun's own limit [s]; None for :data:`.LIMIT_S` without progress.

        Raises:
            RuntimeError: If Rerun can't send, or its own limit is reached.
            NoAnswerError: If Rerun makes no progress, or doesn't keep its limit.
        """
        limit_s = LIMIT_S if timeout_sec is None else timeout_sec + _OVER_S
        longest_s = 1e38 if timeout_sec is None else timeout_sec
        self._attended(partial(super().flush, timeout_sec=longest_s), limit_s, self.look)
        self.look()

    def send_stream(self, chunks: LazyChunkStream, progress: Callable[[], object]) -> None:
        """Send chunks as they are read.

        Args:
            progress: Returns anything that changes when one was read.

        Raises:
            RuntimeError: If Rerun can't read or send them.
            NoAnswerError: If neither reading nor sending makes progress.
        """
        call = partial(super().send_chunks, chunks)
        self._attended(call, LIMIT_S, self.look, lambda: (progress(), self.progress()))
        self.look()

    def disconnect(self) -> None:
        """Send what is left and close the sink.

        Raises:
            NoAnswerError: If Rerun makes no progress.
        """
        self._attended(super().disconnect, LIMIT_S, lambda: None)

    def _attended(
        self,
        call: Callable[[], None],
        limit_s: float,
        look: Callable[[], None],
        progress: Callable[[], object] | None = None,
    ) -> None:
        moved = progress or self.progress
        try:
            attended(call, _WHAT, _ADVICE, limit_s=limit_s, progress=moved, look=look)
        except NoAnswerError:
            keep_for_ever(self)
            raise


def keep_for_ever(rec: rr.RecordingStream) -> None:
    """Never release a stream that stands still: Rerun would wait for it, at our exit as well."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(rec))
    rr.unregister_shutdown()


class RrdFile(Closing):
    """A .rrd file that recording streams are written to, by a thread of ours."""

    def __init__(self, draft: Path, path: Path, *, limit_s: float = LIMIT_S) -> None:
        """Create the file.

        Args:
            draft: The file.
            path: What it will be called, for messages.
            limit_s: Longest time for which the disk may take nothing [s].

        Raises:
            LogWriteError: If it can't be created.
        """
        self.path, self.taken = path, 0
        """Bytes that were written or dropped, as a measure of progress."""
        self._limit_s = limit_s
        self._error: OSError | None = None
        self._dropping = False
        self._ended, self._lock = threading.Event(), threading.Lock()
        try:
            self._file = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise self._failed(error) from error
        self._pipe, self._far_end = os.pipe()
        with suppress(OSError):  # the pipes of this user have taken their share: it stays small
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE)
        self._thread = threading.Thread(target=self._write, name=f"write {path}", daemon=True)
        self._thread.start()

    def connect(self, rec: rr.RecordingStream) -> None:
        """Give the stream this file as its sink.

        Raises:
            LogWriteError: If Rerun can't open it.
        """
        try:
            rec.save(f"/dev/fd/{self._far_end}")
        except (RuntimeError, OSError) as error:
            raise LogWriteError(self.path, f"can't be written: {error}") from error
        finally:
            os.close(self._far_end)
            self._far_end = -1
        if isinstance(rec, BoundedStream):
            rec.progress, rec.look = lambda: self.taken, self.check

    def check(self) -> None:
        """Look whether a write has failed.

        Raises:
            LogWriteError: If it has; Rerun's data are dropped from then on.
        """
        if self._error is not None:
            raise self._failed(self._error) from self._error

    def finish(self) -> None:
        """Wait until all is on disk; the streams must have been disconnected.

        Raises:
            LogWriteError: If it isn't, or the disk takes nothing within the limit.
        """
        self._end()
        still = Standstill(self._limit_s)
        while not self._ended.wait(_LOOK_S):
            if still.reached(self.taken):
                text = f"the disk took nothing within {self._limit_s:g} s; is it still there?"
                raise LogWriteError(self.path, text)
        self.check()

    def close(self) -> None:
        """Drop what is not written; safe to call twice, and after :meth:`finish`."""
        self._end()
        self._dropping = True
        if self._ended.wait(_LOOK_S):
            return
        with self._lock:  # it writes still, or the disk has stopped it for good
            pipe = -1 if self._ended.is_set() else os.dup(self._pipe)
        if pipe >= 0:
            threading.Thread(target=self._drop, args=(pipe,), name="drop", daemon=True).start()

    def _end(self) -> None:
        if self._far_end >= 0:  # Rerun never opened it
            os.close(self._far_end)
            self._far_end = -1

    def _write(self) -> None:
        buffer = memoryview(bytearray(_PIPE))
        unsynced = 0
        try:
            while count := os.readv(self._pipe, [buffer]):
                at = 0
                while at < count and not self._dropping:
                    written = os.write(self._file, buffer[at:count])
                    at += written
                    self.taken += written
                    unsynced += written
                if unsynced >= _SYNC:
                    os.fsync(self._file)
                    unsynced = 0
            os.fsync(self._file)
        except OSError as error:
            self._error = error
            self._drop(os.dup(self._pipe))
        finally:
            with self._lock:
                os.close(self._pipe)
                os.close(self._file)
                self._ended.set()

    def _drop(self, pipe: int) -> None:
        """Take the rest of the data, so that Rerun gets to its end, and forget it."""
        while data := os.read(pipe, _PIPE):
            self.taken += len(data)
        os.close(pipe)

    def _failed(self, error: OSError) -> LogWriteError:
        return LogWriteError(self.path, f"can't be written: {error.strerror or error}")
