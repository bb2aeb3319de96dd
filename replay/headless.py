"""Pictures of a recording without a window: for the manual and for tests of what is drawn.

Rerun's viewer draws off screen where there is a Vulkan driver, Mesa's software one included.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from rerun.experimental import View, ViewerClient

from undulog.capture.common.errors import UndulogError

from .samples.timeline import ENSEMBLE_CYCLE, SESSION_TIME
from .viewer import Viewer

_START_S = 60.0
_REST_S = 30.0
_LOOK_AGAIN_S = 0.2
# Equal pictures in a row of the empty window after which its greetings are over.
_GREETINGS_GONE = 8


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

    def open(self, recording: Path, seconds: float) -> None:
        """Show a recording in its own layout, standing still, instead of what was shown before.

        Args:
            seconds: Place on ``session_time`` [s].
        """
        again = bool(self._client.get_state().recordings)
        if again:
            self._client.close("all")
        self._client.open(str(recording.resolve()))
        while self._client.get_state().loading:
            time.sleep(_LOOK_AGAIN_S)
        if again:  # it would keep the layout of the last one
            self._client.run_command("recording.reset_blueprint_to_default")
        self.seek(seconds)

    def seek(self, seconds: float) -> None:
        """Stand still at another time.

        Args:
            seconds: Place on ``session_time`` [s].
        """
        self._client.set_time(SESSION_TIME, duration=seconds, play_state="paused")

    def seek_phase(self, degrees: int) -> None:
        """Stand still at a phase of the mean cycle.

        Args:
            degrees: Place on ``ensemble_cycle`` [degrees].
        """
        self._client.set_time(ENSEMBLE_CYCLE, sequence=degrees, play_state="paused")

    @property
    def views(self) -> dict[str, View]:
        """All views by name, those behind tabs included."""
        return {view.name: view for view in self._client.get_state().views}

    def complaints(self) -> list[str]:
        """Return the errors that the views report."""
        self.picture()
        views = self._client.get_state().views
        return [f"{view.name}: {one.summary}" for view in views for one in view.reports]

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
        last = self._client.take_screenshot(view_id)
        while time.monotonic() < deadline:
            shot = self._client.take_screenshot(view_id)
            if shot == last:
                return shot
            last = shot
            time.sleep(_LOOK_AGAIN_S)
        raise UndulogError("the viewer's picture doesn't come to rest")

    def _let_greetings_pass(self) -> None:
        """Wait for the end of its notices, which lie over the first pictures and don't move."""
        deadline = time.monotonic() + _REST_S
        last, equal = b"", 0
        while equal < _GREETINGS_GONE:
            if time.monotonic() > deadline:
                raise UndulogError("the headless viewer's notices don't go away")
            shot = self._client.take_screenshot(max_size=64)
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
    deadline = time.monotonic() + _START_S
    while True:
        try:
            client = ViewerClient.connect(address)
            client.get_state()
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
