"""The relay as a process of its own, started beside a recording and out of its way."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..common.errors import MissingExtraError, UndulogError

_GRACE_S = 3.0


class RelayProcess:
    """A running relay, with its viewer if it has one."""

    def __init__(self, process: subprocess.Popen[bytes], complaints: Path) -> None:
        """Wrap it.

        Args:
            process: The relay, leader of a session of its own.
            complaints: The file that its standard error goes to.
        """
        self._process = process
        self._complaints = complaints

    @property
    def pid(self) -> int:
        """Its process id, and that of its process group."""
        return self._process.pid

    def poll(self) -> int | None:
        """Its exit code, or None while it runs; never waits."""
        return self._process.poll()

    def complaint(self) -> str:
        """The last line that it wrote on its standard error; empty where there is none."""
        try:
            lines = self._complaints.read_text(errors="replace").splitlines()
        except FileNotFoundError:
            return ""
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def close(self, *, leave_window: bool = False) -> None:
        """End it and all that it started, within seconds; safe to call twice.

        Args:
            leave_window: Leave it, so that the viewer's window can still be looked at; the relay
                ends when the window is closed.
        """
        if not leave_window:
            self._end()
        self._complaints.unlink(missing_ok=True)

    def _end(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        try:  # a viewer that a killed relay has left
            os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:
            return


def spawn_relay(path: Path, arguments: Sequence[str] = ()) -> RelayProcess:
    """Start ``undulog view --live PATH`` in a session of its own.

    An interrupt in the recorder's terminal doesn't reach it: the recorder ends it, or leaves it.

    Args:
        path: The socket that the relay will make.
        arguments: Further options of the verb, e.g. ``--web``.

    Returns:
        The relay; look at :meth:`RelayProcess.poll` now and then.

    Raises:
        MissingExtraError: If Rerun is not installed; a recording goes on without.
        UndulogError: If the process can't be started.
    """
    if importlib.util.find_spec("rerun") is None:
        raise MissingExtraError("the live view", "replay", "rerun")
    handle, name = tempfile.mkstemp(prefix="undulog-live-", suffix=".txt")
    try:
        process = subprocess.Popen(  # noqa: S603  our own arguments
            [sys.executable, "-m", "undulog", "view", "--live", str(path), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=handle,
            stderr=handle,
            start_new_session=True,
        )
    except OSError as error:
        Path(name).unlink()
        raise UndulogError(f"the live view can't be started: {error}") from error
    finally:
        os.close(handle)
    return RelayProcess(process, Path(name))
