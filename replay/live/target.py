"""Where a live picture goes: a window or a browser."""

from __future__ import annotations

from collections.abc import Callable

from ..viewer import viewer
from ..viewer.viewer import Viewer

_WINDOW = "--memory-limit=1GB"
_SERVER = "--server-memory-limit=256MB"


def open_window() -> Viewer:
    """Open the native viewer, empty.

    Returns:
        The viewer.

    Raises:
        UndulogError: If it doesn't start.
    """
    return _ready(viewer.open_window(_WINDOW))


def open_server(tell: Callable[[str], None]) -> Viewer:
    """Serve the viewer to browsers on this machine.

    Args:
        tell: Called with the address to open, once it is served.

    Returns:
        The server.

    Raises:
        UndulogError: If it doesn't start.
    """
    server, page = viewer.open_server(_SERVER)
    _ready(server)
    tell(page)
    return server


def _ready(started: Viewer) -> Viewer:
    try:
        started.wait_until_it_listens()
    except BaseException:
        started.close()
        raise
    return started
