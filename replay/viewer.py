"""Rerun's own viewer as a process of ours, with or without a window, for this machine only.

Rerun's ``spawn`` and ``serve`` listen on all interfaces by default; here every server is bound to
127.0.0.1.

Rerun's viewer draws off screen where there is a Vulkan driver, Mesa's software one included.
"""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import quote

from undulog.capture.common.errors import MissingExtraError, NoAnswerError, UndulogError, UsageError
from undulog.capture.common.process import StopRequest, interruptible
from undulog.capture.common.waits import Standstill, attended, end_process

if TYPE_CHECKING:
    from rerun.experimental import View, ViewerClient

_Answer = TypeVar("_Answer")

LOOPBACK = "127.0.0.1"

WHOLE_IN_MEMORY = "--server-memory-limit=75%"
"""A server keeps the whole recording for browsers that come late, whatever memory that takes: by
Rerun's own limit, 1 GiB, a session of some hours would lose its beginning."""

# A window holds the recording itself: what its own server keeps beside that is there twice.
_PASSING_ON = "--server-memory-limit=64MB"

_START_S = 60.0
LOAD_S = 600.0
"""Longest time for which the headless viewer may load a recording [s]: hours of 25 joints, 1 GB,
take a minute on two cores."""

_VIEWER = "the Rerun viewer"
_ADVICE = "it is frozen or too busy; start the command again"
_RESET_LAYOUT = "recording.reset_blueprint_to_default"
_LOOK_S = 0.05
_GRACE_S = 3.0
_REST_S = 30.0
_LOOK_AGAIN_S = 0.2
# Equal pictures in a row of the empty window after which its greetings are over.
_GREETINGS_GONE = 8


def viewer_binary() -> Path:
    """Return the path of the viewer that came with the installed Rerun.

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


class Viewer(AbstractContextManager["Viewer"]):
    """A viewer, or a server of one, as a process of ours that only this machine reaches."""

    def __init__(self, arguments: Sequence[str], port: int | None = None) -> None:
        """Start it.

        Args:
            arguments: Of the viewer's command line, its port and address left out.
            port: Where it takes data; None for a free port.

        Raises:
            MissingExtraError: If Rerun is not installed.
        """
        binary = viewer_binary()
        self._port = free_ports(1)[0] if port is None else port
        self.address = f"rerun+http://{LOOPBACK}:{self._port}/proxy"
        """Where a recording stream connects to."""
        # The viewer leaves a folder behind when it is terminated; it is removed with ours.
        self._scratch = tempfile.TemporaryDirectory(prefix="undulog-viewer-")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process
        self._closing = False
        self._process = subprocess.Popen(  # noqa: S603  our own arguments
            [str(binary), "--bind", LOOPBACK, "--port", str(self._port), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env={**os.environ, "TMPDIR": self._scratch.name},
            process_group=0,  # a Ctrl-C ends it through us
        )

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    @property
    def ended(self) -> bool:
        """Whether it has ended, e.g. because its window was closed."""
        return self._process.poll() is not None

    def wait_until_it_listens(self) -> None:
        """Wait until data can be sent to it; close it if that fails.

        Raises:
            UndulogError: If it ends before, or doesn't start.
        """
        deadline = time.monotonic() + _START_S
        with ExitStack() as on_failure:
            on_failure.callback(self.close)
            while not _listens(self._port):
                if self.ended:
                    self.check()
                    raise UndulogError("the Rerun viewer ended before it showed anything")
                if time.monotonic() > deadline:
                    raise UndulogError(f"the Rerun viewer did not start within {_START_S:g} s")
                time.sleep(_LOOK_S)
            on_failure.pop_all()

    def wait(self, stop: StopRequest) -> None:
        """Wait until it has ended, or a stop is requested.

        Args:
            stop: The request to look at.

        Raises:
            UndulogError: If it fails.
        """
        while not self.ended and not stop.requested:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_LOOK_S)
        if not stop.requested:
            self.check()

    def check(self) -> None:
        """Look whether it has failed.

        Raises:
            UndulogError: If it has ended, and neither by closing its window nor by us.
        """
        if self._closing or not self._process.poll():
            return
        code = self._process.returncode
        if code < 0:
            raise UndulogError(f"the Rerun viewer was ended by signal {-code}")
        self._errors.seek(0)
        text = self._errors.read().decode(errors="replace").splitlines()
        lines = [line for line in text if "Error" in line] or text[-3:]
        reason = " ".join(line.strip() for line in lines) or f"exit code {code}"
        raise UndulogError(f"the Rerun viewer failed: {reason}")

    def close(self) -> None:
        """End it, frozen or not; safe to call twice."""
        self._closing = self._closing or not self.ended
        try:
            end_process(self._process, "the Rerun viewer", grace_s=_GRACE_S)
        finally:
            self._scratch.cleanup()
            self._errors.close()


def open_window(*options: str) -> Viewer:
    """Open the native viewer, empty.

    Args:
        options: More of its command line.
    """
    return Viewer(["--hide-welcome-screen", "--expect-data-soon", _PASSING_ON, *options])


def open_server(*options: str) -> tuple[Viewer, str]:
    """Serve the viewer to browsers on this machine.

    Args:
        options: More of its command line.

    Returns:
        The server, which starts, and the address that a browser opens.
    """
    page, data = free_ports(2)
    source = quote(f"rerun+http://{LOOPBACK}:{data}/proxy", safe="")
    server = Viewer(["--serve-web", "--web-viewer-port", str(page), *options], data)
    return server, f"http://{LOOPBACK}:{page}/?url={source}"


def show(recording: Path) -> None:
    """Open a recording in the native viewer and wait until its window is closed.

    Raises:
        UndulogError: If the viewer fails.
    """
    with interruptible() as stop, Viewer([str(recording)]) as viewer:
        viewer.wait(stop)


def serve(recording: Path, notify: Callable[[str], None]) -> None:
    """Serve a recording to browsers on this machine until interrupted.

    Args:
        notify: Called with the address to open.

    Raises:
        UndulogError: If the server fails.
    """
    with interruptible() as stop:
        server, page = open_server(WHOLE_IN_MEMORY, str(recording))
        with server:
            notify(page)
            server.wait(stop)


def free_ports(count: int) -> list[int]:
    """Return free ports of this machine."""
    with ExitStack() as stack:
        held = [stack.enter_context(socket.create_server((LOOPBACK, 0))) for _ in range(count)]
        return [int(server.getsockname()[1]) for server in held]


def _listens(port: int) -> bool:
    try:
        with socket.create_connection((LOOPBACK, port), timeout=1.0):
            return True
    except OSError:
        return False


class HeadlessViewer(AbstractContextManager["HeadlessViewer"]):
    """A viewer without a window, which this machine only can reach."""

    def __init__(self, size: tuple[int, int] = (1440, 900)) -> None:
        """Start it.

        Args:
            size: Width and height of the window that isn't there [pixels].

        Raises:
            MissingExtraError: If Rerun is not installed.
            UndulogError: If it doesn't start, e.g. without a Vulkan driver.
        """
        window = f"--window-size={size[0]}x{size[1]}"
        self._viewer = Viewer(["--headless", "--hide-welcome-screen", window])
        try:
            self._client = client_of(self._viewer.address, lambda: self._viewer.ended)
            self._let_greetings_pass()
        except (OSError, RuntimeError) as error:
            self.close()
            raise _not_started() from error  # it may answer before it asks for a driver
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    def close(self) -> None:
        """End it; safe to call twice."""
        self._viewer.close()

    @property
    def address(self) -> str:
        """Where recordings can be sent to."""
        return self._viewer.address

    def open(self, recording: Path, seconds: float) -> None:
        """Show a recording in its own layout, standing still, instead of what was shown before.

        Args:
            seconds: Place on ``session_time`` [s].
        """
        again = bool(self._asked(self._client.get_state).recordings)
        if again:
            self._asked(partial(self._client.close, "all"))
        self._asked(partial(self._client.open, str(recording.resolve())))
        still = Standstill(LOAD_S)
        while self._asked(self._client.get_state).loading:
            if still.reached():
                raise NoAnswerError(_VIEWER, LOAD_S, f"it is loading {recording} still; {_ADVICE}")
            time.sleep(_LOOK_AGAIN_S)
        if again:  # it would keep the layout of the last one
            self._asked(partial(self._client.run_command, _RESET_LAYOUT))
        self.seek(seconds)

    def seek(self, seconds: float) -> None:
        """Stand still at another time.

        Args:
            seconds: Place on ``session_time`` [s].
        """
        from .samples.timeline import SESSION_TIME

        at = {"duration": seconds}
        self._asked(partial(self._client.set_time, SESSION_TIME, play_state="paused", **at))

    def seek_phase(self, degrees: int) -> None:
        """Stand still at a phase of the mean cycle.

        Args:
            degrees: Place on ``ensemble_cycle`` [degrees].
        """
        from .samples.timeline import ENSEMBLE_CYCLE

        at = {"sequence": degrees}
        self._asked(partial(self._client.set_time, ENSEMBLE_CYCLE, play_state="paused", **at))

    @property
    def views(self) -> dict[str, View]:
        """All views by name, those behind tabs included."""
        return {view.name: view for view in self._asked(self._client.get_state).views}

    def complaints(self) -> list[str]:
        """Return the errors that the views report."""
        self.picture()
        views = self._asked(self._client.get_state).views
        return [f"{view.name}: {report.summary}" for view in views for report in view.reports]

    def picture(self, view: str | None = None) -> bytes:
        """Return a picture, once two shots in a row agree.

        Args:
            view: Name of a view in front, or None for the whole window.

        Raises:
            ConnectionError: If the view is behind a tab.
            UndulogError: If the picture doesn't come to rest.
        """
        return self.picture_of(None if view is None else self.views[view].view_id)

    def picture_of(self, view_id: str | None) -> bytes:
        """Return a picture by a view's id, for many in a row.

        Args:
            view_id: As :attr:`views` has it, or None for the whole window.

        Raises:
            ConnectionError: If the view is behind a tab.
            UndulogError: If the picture doesn't come to rest.
        """
        deadline = time.monotonic() + _REST_S
        shoot = partial(self._client.take_screenshot, view_id)
        last = self._asked(shoot)
        while time.monotonic() < deadline:
            shot = self._asked(shoot)
            if shot == last:
                return shot
            last = shot
            time.sleep(_LOOK_AGAIN_S)
        raise UndulogError("the viewer's picture doesn't come to rest")

    def _asked(self, call: Callable[[], _Answer]) -> _Answer:
        """Return the viewer's answer to a request, which Rerun waits for without a limit."""
        return attended(call, _VIEWER, _ADVICE)

    def _let_greetings_pass(self) -> None:
        """Wait for the end of its notices, which lie over the first pictures and don't move."""
        deadline = time.monotonic() + _REST_S
        last, equal = b"", 0
        while equal < _GREETINGS_GONE:
            if time.monotonic() > deadline:
                raise UndulogError("the headless viewer's notices don't go away")
            shot = self._asked(partial(self._client.take_screenshot, max_size=64))
            last, equal = shot, equal + 1 if shot == last else 0


def client_of(
    address: str, ended: Callable[[], bool] = lambda: False, *, look_s: float = _LOOK_AGAIN_S
) -> ViewerClient:
    """Return a client of a viewer, once it answers.

    Args:
        ended: Whether it has ended, so that waiting is in vain.
        look_s: How often to look [s].

    Returns:
        What asks it for its state and its pictures.

    Raises:
        UndulogError: If it ends before, or doesn't answer within a minute.
    """
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + _START_S
    while True:
        try:
            connect = partial(ViewerClient.connect, address)
            client = attended(connect, _VIEWER, _ADVICE, limit_s=_START_S)
            attended(client.get_state, _VIEWER, _ADVICE, limit_s=_START_S)
        except NoAnswerError:
            raise
        except (ConnectionError, RuntimeError, TimeoutError) as error:
            if ended() or time.monotonic() > deadline:
                raise _not_started() from error
            time.sleep(look_s)
        else:
            return client


def _not_started() -> UndulogError:
    return UndulogError(
        "the headless viewer did not start; it needs a Vulkan driver "
        "(Debian: mesa-vulkan-drivers libvulkan1)"
    )
