"""systemd: the unit that comes with the recorder, and notifications of the service manager.

Protocol: https://www.freedesktop.org/software/systemd/man/latest/sd_notify.html, datagrams of
``KEY=VALUE`` lines to the socket that ``NOTIFY_SOCKET`` names. Without it nothing is sent. Sending
never waits and never fails: datagrams that can't be sent are counted, and the manager's watchdog
acts on missing ones.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from ..common.errors import UsageError

_LONGEST_STATUS = 512
_WATCHDOG_PART = 0.5  # of the time after which the manager gives us up, as sd_notify(3) advises

UNIT_NAME = "undulog-record@.service"
"""File name of the unit; the part after the @ names the settings."""

HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - named, not used
"""Folders that the unit hides from the recorder."""

_REFUSED = "\"'\\*?["  # not allowed in a program's name by systemd
_SHIPPED_PROGRAM = "/usr/local/bin/undulog"


class Notifier:
    """Notifies the service manager, if there is one.

    Attributes:
        failed: Number of messages that could not be sent.
        watchdog_ns: Silence after which the manager acts [ns]; None without a watchdog.
    """

    def __init__(self, environ: Mapping[str, str]) -> None:
        """Read ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` of the environment."""
        self.failed = 0
        self.watchdog_ns = _watchdog_ns(environ)
        self._address = _address(environ.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        self._next_beat_ns = 0
        self._status = ""

    @property
    def is_service(self) -> bool:
        """Whether a service manager runs this process."""
        return self._address is not None

    def ready(self, status: str = "") -> None:
        """Report that the recording has begun; ``status`` is for ``systemctl status``."""
        self._send("READY=1", *self._status_line(status))

    def status(self, text: str) -> None:
        """Report a changed status, one sentence for ``systemctl status``."""
        if text != self._status:
            self._send(*self._status_line(text))

    def alive(self, now_ns: int | None = None) -> None:
        """Report a sign of life, as often as the manager's watchdog needs it.

        Called every tick by the loop that must not hang, never by another thread.

        Args:
            now_ns: Monotonic clock [ns]; the system's by default.
        """
        if self.watchdog_ns is None or self._socket is None:
            return
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        if now_ns >= self._next_beat_ns:
            self._next_beat_ns = now_ns + int(self.watchdog_ns * _WATCHDOG_PART)
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Report that the recording ends."""
        self._status = ""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket; nothing is sent any more. Safe to call twice."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _status_line(self, text: str) -> tuple[str, ...]:
        self._status = text
        line = " ".join(text.split())[:_LONGEST_STATUS]  # a newline would begin another key
        return (f"STATUS={line}",) if line else ()

    def _send(self, *lines: str) -> None:
        if self._socket is None or self._address is None or not lines:
            return
        try:
            self._socket.sendto("\n".join(lines).encode("utf-8", "replace"), self._address)
        except OSError:  # full, or closed: no reason to end the recording
            self.failed += 1


def _address(name: str) -> bytes | None:
    """Return the socket's address; None if it is not that of a Unix socket."""
    if name.startswith("@"):  # abstract: no file
        return b"\0" + os.fsencode(name[1:])
    return os.fsencode(name) if name.startswith("/") else None


def _watchdog_ns(environ: Mapping[str, str]) -> int | None:
    text, owner = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if owner and owner != str(os.getpid()):
        return None  # inherited, for another process
    return int(text) * 1000 if text.isascii() and text.isdigit() and int(text) > 0 else None


def unit_text(program: Path) -> str:
    """Return the text of the unit for the ``undulog`` command at an absolute path.

    Raises:
        UsageError: If a unit can't contain the path.
    """
    text = str(program)
    odd = [letter for letter in text if letter in _REFUSED or not letter.isprintable()]
    if not program.is_absolute() or odd:
        raise UsageError(
            f"{program}: a unit needs an absolute path of the command, without "
            "quotes, backslashes, *, ? and ["
        )
    place = resources.files("undulog.capture.recorder") / "shipped" / UNIT_NAME
    quoted = text.replace("%", "%%")  # which begins a specifier
    quoted = f'"{quoted}"' if " " in quoted or ";" in quoted else quoted
    return place.read_text(encoding="utf-8").replace(_SHIPPED_PROGRAM, quoted)


def installed_program() -> Path:
    """Return the ``undulog`` command beside the running interpreter.

    Raises:
        UsageError: If there is none, as undulog is not installed as a package.
    """
    program = Path(sys.executable).parent / "undulog"
    if not program.is_file():
        raise UsageError(f"{program} is not there; install undulog as a package")
    return program


def hidden_folder(program: Path) -> str | None:
    """Return the one of :data:`HIDDEN` that contains a program, or None."""
    where = (program.absolute(), program.resolve())
    return next(
        (folder for folder in HIDDEN if any(Path(folder) in p.parents for p in where)), None
    )
