"""Command ``view`` as it is used: a process of its own, and Rerun's viewer without a window."""

import os
import signal
import sys
from collections import deque
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from support import golden_pictures, processes
from support.processes import freeze, wait_for
from undulog.replay.viewer import Viewer, client_of

pytestmark = pytest.mark.slow

WAIT_S = 120
LONG_S = 4000
# The same command; the viewer draws off screen, since a test has no display.
HEADLESS = """
import sys
import undulog
from undulog.replay import viewer

def without_window(*options):
    window = viewer.Viewer(["--headless", "--hide-welcome-screen", "--window-size=1440x900"])
    print(window.address, flush=True)
    return window

viewer.open_window = without_window
viewer.require_display = lambda: None
undulog.main()
"""


def until(condition):
    return processes.wait_for(condition, seconds=WAIT_S)


class Shown:
    """The command, and what its viewer shows."""

    def __init__(self, file, scratch, *options):
        self.scratch = scratch
        words, env = (sys.executable, "-c", HEADLESS, "view", file), {"TMPDIR": str(scratch)}
        self.process = processes.start(*words, *options, env=os.environ | env)
        address = self.process.stdout.readline().strip()
        page, _, query = address.partition("/?url=")
        self.page, self.address = page, unquote(query) if query else address
        if not query:
            self.look_into(self.address)

    def look_into(self, address):
        """Look into a viewer."""
        self.client = client_of(address, lambda: self.process.poll() is not None)

    @property
    def views(self):
        return {view.name: view.view_id for view in self.client.get_state().views}

    @property
    def at_s(self):
        (recording,) = self.client.get_state().recordings
        return None if recording.current_time is None else recording.current_time * 1e-9

    def picture(self, rgb, name):
        return rgb(self.client.take_screenshot(self.views[name]))

    def finish(self):
        out, err = self.process.communicate(timeout=WAIT_S)
        return self.process.returncode, out, err


@pytest.fixture(scope="module")
def long_file(write_long, tmp_path_factory):
    return write_long(tmp_path_factory.mktemp("long") / "long.mcap", seconds=LONG_S)


@pytest.fixture
def view(vulkan, tmp_path):
    """Starts the command; none of it is left."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    shown = []

    def start(file, *options):
        shown.append(Shown(file, scratch, *options))
        return shown[-1]

    yield start
    for viewer in shown:
        if viewer.process.poll() is None:
            viewer.process.send_signal(signal.SIGTERM)
        viewer.process.communicate(timeout=WAIT_S)
    assert list(scratch.iterdir()) == []


def glows(picture):
    return golden_pictures.glowing(picture).sum()


def body_of(views):
    return next((name for name in views if name.startswith("Body")), None)


def until_the_body_stands(shown, rgb):
    """Wait for the first picture of the body; its view's name."""

    def stands():
        name = body_of(shown.views)
        return name if name and glows(shown.picture(rgb, name)) > 300 else None

    return until(stands)


@pytest.fixture
def shown(view, long_file, rgb):
    """The command while it converts, with the body in its viewer."""
    shown = view(long_file)
    until_the_body_stands(shown, rgb)
    return shown


def viewer_of(shown):
    """Process id of the viewer."""
    pid = shown.process.pid
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    arguments = {int(pid): Path(f"/proc/{pid}/cmdline").read_bytes() for pid in children}
    return next(pid for pid, line in arguments.items() if b"--headless" in line)


@pytest.mark.nightly
def test_the_body_comes_first_and_whoever_looks_keeps_his_place(view, long_file, rgb):
    shown = view(long_file)
    body = until_the_body_stands(shown, rgb)
    shown.client.set_time("session_time", duration=12.5, play_state="paused")
    ids = shown.views
    lag = rgb(shown.client.take_screenshot(ids["Lag [°]"]))
    line = until(shown.process.stdout.readline)
    assert line == f"{long_file}: {LONG_S - 0.2:.1f} s, all of it in the viewer\n"
    assert (shown.at_s, shown.views) == (12.5, ids)
    assert until(lambda: np.abs(shown.picture(rgb, "Lag [°]") - lag).max() > 60)
    shown.client.set_time("session_time", duration=LONG_S - 5.0, play_state="paused")
    until(lambda: glows(shown.picture(rgb, body)) > 300)
    assert [panel.reports for panel in shown.client.get_state().views if panel.reports] == []
    shown.process.send_signal(signal.SIGINT)
    code, _, err = shown.finish()
    assert (code, err) == (0, "")


@pytest.mark.nightly
def test_a_tab_that_was_asked_for_comes_to_the_front_with_its_numbers(view, long_file, rgb):
    shown = view(long_file, "--tab", "cycles")
    until_the_body_stands(shown, rgb)
    until(shown.process.stdout.readline)
    until(lambda: any(name.startswith("Lag map, ") for name in shown.views))
    name = next(name for name in shown.views if name.startswith("Lag map, "))
    assert shown.picture(rgb, name).std() > 5  # a view behind a tab has no picture


@pytest.mark.nightly
def test_closing_the_window_while_it_is_converted_ends_the_command(shown):
    shown.client.run_command("ui.quit")
    assert shown.finish() == (0, "", "")


def test_an_interrupt_while_it_is_converted_ends_the_command(shown):
    viewer = viewer_of(shown)
    shown.process.send_signal(signal.SIGINT)
    assert shown.finish() == (0, "", "")
    assert not Path(f"/proc/{viewer}").exists()


@pytest.mark.nightly
def test_a_viewer_that_is_killed_is_reported(shown):
    os.kill(viewer_of(shown), signal.SIGKILL)
    assert shown.finish() == (1, "", "error: the Rerun viewer was ended by signal 9\n")


def processor_ticks(pid):
    """Processor time of a process so far [clock ticks]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


@pytest.mark.nightly
def test_a_frozen_viewer_takes_no_memory_and_can_be_ended(shown):
    viewer, pid = viewer_of(shown), shown.process.pid
    freeze(viewer)
    looks = deque(maxlen=30)

    def megabytes():
        pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6

    def waits():  # for the viewer: it looks whether it is still wanted, and does nothing else
        looks.append(processor_ticks(pid))
        return len(looks) == looks.maxlen and looks[-1] - looks[0] <= 3

    before = megabytes()
    wait_for(waits, "a viewer that takes nothing", alive=[shown.process], pause_s=0.1)
    assert megabytes() < before + 50.0  # of some hundred that are still to be sent
    shown.process.send_signal(signal.SIGTERM)
    assert shown.finish() == (0, "", "")
    assert not Path(f"/proc/{viewer}").exists()


@pytest.mark.nightly
def test_who_looks_at_the_served_session_late_gets_its_beginning(view, long_file, rgb):
    shown = view(long_file, "--web")
    assert shown.page.startswith("http://127.0.0.1:")
    until(shown.process.stdout.readline)
    with Viewer(["--headless", "--hide-welcome-screen", "--connect", shown.address]) as late:
        shown.look_into(late.address)
        body = until_the_body_stands(shown, rgb)
        shown.client.set_time("session_time", duration=1.0, play_state="paused")
        until(lambda: glows(shown.picture(rgb, body)) > 300)
        (recording,) = shown.client.get_state().recordings
        spans = {timeline.name: (timeline.start, timeline.end) for timeline in recording.timelines}
        assert spans["session_time"][0] == 0
        assert spans["session_time"][1] >= round((LONG_S - 0.2) * 1e9)
