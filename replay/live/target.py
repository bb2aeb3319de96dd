"""Where a live picture goes: a window, a browser, a viewer elsewhere, or a file."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self
from urllib.parse import quote

from capture.errors import UndulogError

from ..viewer import LOOPBACK, free_ports, viewer_binary

_START_S = 60.0
_LOOK_AGAIN_S = 0.1
_GRACE_S = 3.0
_VIEWER_MEMORY = "1GB"
_SERVER_MEMORY = "256MB"


class LiveViewer:
    """A viewer, or a server of one, as a process of ours that only this machine reaches."""

    def __init__(self, arguments: list[str], port: int) -> None:
        """Start it and wait until it listens.

        Args:
            arguments: Of the viewer's command line, its port and address left out.
            port: Where it takes data.

        Raises:
            UndulogError: If it doesn't start.
        """
        self.address = f"rerun+http://{LOOPBACK}:{port}/proxy"
        """Where a recording stream connects to."""
        place = ["--bind", LOOPBACK, "--port", str(port)]
        self._process = subprocess.Popen(  # noqa: S603  our own arguments
            [str(viewer_binary()), *place, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + _START_S
        while not _listens(port):
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.close()
                raise UndulogError("the Rerun viewer did not start")
            time.sleep(_LOOK_AGAIN_S)

    def __enter__(self) -> Self:
        """Nothing to do: it runs."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it."""
        self.close()

    @property
    def ended(self) -> bool:
        """Whether it has ended, e.g. because its window was closed."""
        return self._process.poll() is not None

    def close(self) -> None:
        """End it, frozen or not; safe to call twice."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()


def open_window() -> LiveViewer:
    """Open the native viewer, empty.

    Returns:
        The viewer.

    Raises:
        UndulogError: If it doesn't start.
    """
    (port,) = free_ports(1)
    window = ["--hide-welcome-screen", "--expect-data-soon", "--memory-limit", _VIEWER_MEMORY]
    return LiveViewer(window, port)


def open_server(tell: Callable[[str], None]) -> LiveViewer:
    """Serve the viewer to browsers on this machine.

    Args:
        tell: Called with the address to open, once it is served.

    Returns:
        The server.

    Raises:
        UndulogError: If it doesn't start.
    """
    page, data = free_ports(2)
    source = quote(f"rerun+http://{LOOPBACK}:{data}/proxy", safe="")
    arguments = ["--serve-web", "--web-viewer-port", str(page)]
    server = LiveViewer([*arguments, "--server-memory-limit", _SERVER_MEMORY], data)
    tell(f"http://{LOOPBACK}:{page}/?url={source}")
    return server


def _listens(port: int) -> bool:
    try:
        with socket.create_connection((LOOPBACK, port), timeout=1.0):
            return True
    except OSError:
        return False
