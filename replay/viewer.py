"""Rerun's own viewer as a process of ours, reachable from this machine only.

Rerun's ``spawn`` and ``serve`` listen on all interfaces unless told; here every server is bound to
127.0.0.1.
"""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import quote

from capture.errors import MissingExtraError, UndulogError, UsageError
from capture.interruption import interruptible

LOOPBACK = "127.0.0.1"


def viewer_binary() -> Path:
    """The viewer that came with the installed Rerun.

    Returns:
        Path of the executable.

    Raises:
        MissingExtraError: If Rerun is not installed.
    """
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError("'undulog view'", "replay", "rerun")
    folder = Path(spec.submodule_search_locations[0])
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    if bundled.exists():
        return bundled
    return folder / ("rerun.exe" if sys.platform == "win32" else "rerun")


def require_display() -> None:
    """Check that a window can be opened, before any work is done.

    Raises:
        UsageError: If this is a Linux machine without a display.
    """
    if sys.platform.startswith("linux") and not any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    ):
        raise UsageError(
            "this machine has no display to open the viewer on; write the recording with "
            "--save X.rrd and open it elsewhere, or serve it to a browser with --web"
        )


def show(recording: Path) -> None:
    """Open a recording in the native viewer and wait until its window is closed.

    Args:
        recording: The .rrd file.

    Raises:
        UndulogError: If the viewer fails.
    """
    _run([str(recording), "--bind", LOOPBACK, "--port", "auto"])


def serve(recording: Path, tell: Callable[[str], None]) -> None:
    """Serve a recording to browsers on this machine until interrupted.

    Args:
        recording: The .rrd file.
        tell: Called with the address to open.

    Raises:
        UndulogError: If the server fails.
    """
    page, data = free_ports(2)
    source = quote(f"rerun+http://{LOOPBACK}:{data}/proxy", safe="")
    tell(f"http://{LOOPBACK}:{page}/?url={source}")
    ports = ["--web-viewer-port", str(page), "--port", str(data)]
    _run([str(recording), "--serve-web", "--bind", LOOPBACK, *ports])


def free_ports(count: int) -> list[int]:
    """Ports of this machine that nobody listens on at the moment.

    Args:
        count: How many.

    Returns:
        Different ports.
    """
    with ExitStack() as stack:
        held = [stack.enter_context(socket.create_server((LOOPBACK, 0))) for _ in range(count)]
        return [int(one.getsockname()[1]) for one in held]


def _run(arguments: list[str]) -> None:
    """Run the viewer until it ends or we are told to; either way it is gone afterwards."""
    with interruptible() as stop:
        process = subprocess.Popen(  # noqa: S603  our own arguments
            [str(viewer_binary()), *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        said = ""
        try:
            while True:
                try:
                    _, said = process.communicate(timeout=0.2)
                    break
                except subprocess.TimeoutExpired:
                    if stop.requested:
                        return
        finally:
            if process.poll() is None:
                process.terminate()
                process.communicate()
    if process.returncode != 0 and not stop.requested:
        lines = [line for line in said.splitlines() if "Error" in line] or said.splitlines()[-3:]
        reason = " ".join(line.strip() for line in lines) or f"exit code {process.returncode}"
        raise UndulogError(f"the Rerun viewer failed: {reason}")
