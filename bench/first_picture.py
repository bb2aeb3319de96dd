"""Time from a command to the first whole picture of a long session, held to a bar.

``python bench/first_picture.py [MINUTES | SESSION.mcap]`` takes a session of 25 joints at 100 Hz,
an hour by default, and starts

* ``undulog view SESSION``, from the command to the first whole picture of the body,
* Rerun's viewer on the MCAP file itself, which Rerun reads without us, as a peer, and
* Rerun's viewer on a recording that was converted before,

three times in turn, without a window and of the same size. The first picture of a recording is the
body's, of the session itself the first view that Rerun makes of it. A picture is whole when it is
the one that the viewer still shows five seconds after it came to rest, standing still at its first
moment. ``undulog view`` goes on converting in the meantime: how long until all of it is in the
viewer is printed beside. Other work on the machine delays all of these alike.
"""

import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from live_view import start_viewer
from measuring import write_hour
from records import compared, versions
from rerun.experimental import ViewerClient

from undulog.capture import Session
from undulog.replay import write_recording
from undulog.replay.viewer import client_of

BAR = 0.5
"""To Rerun's viewer on the MCAP file itself."""

REST_S = 5.0
PATIENCE_S = 600.0
SIZE = "--window-size=1440x900"

# The command as it is, but for the window, which a machine without a display can't open.
VIEW = f"""
import sys
import undulog
from undulog.replay import viewer

def without_window(*options):
    window = viewer.Viewer(["--headless", "{SIZE}", "--hide-welcome-screen", *options])
    print(window.address, flush=True)
    return window

viewer.open_window = without_window
viewer.require_display = lambda: None
undulog.main()
"""


def look(address: str, start: float) -> tuple[float, float]:
    """Look at a viewer until nothing changes any more.

    Args:
        address: Where it is.
        start: When the command was given.

    Returns:
        Seconds until the viewer had a view, and until its picture was whole.
    """
    deadline = start + PATIENCE_S
    client = client_of(address, look_s=0.02)
    while not client.get_state().views:
        if time.monotonic() > deadline:
            sys.exit(f"nothing shows within {PATIENCE_S:g} s")
        time.sleep(0.02)
    had_s = time.monotonic() - start
    last, changed_s = b"", had_s
    while time.monotonic() - start < changed_s + REST_S or client.get_state().loading:
        picture = picture_of_body(client)
        if picture != last:
            stand_still(client, deadline)  # again, for it may have begun to play after the first
            last, changed_s = picture, time.monotonic() - start
        if time.monotonic() > deadline:
            sys.exit(f"nothing is at rest within {PATIENCE_S:g} s")
    return had_s, changed_s


def picture_of_body(client: ViewerClient) -> bytes:
    """The body; of a session that Rerun reads without us a view in space, or the first view."""
    views = client.get_state().views
    spatial = [view for view in views if view.view_class == "3D"]
    bodies = [view for view in spatial if view.name.startswith("Body")]
    try:
        return client.take_screenshot((bodies or spatial or views)[0].view_id)
    except ConnectionError:  # Rerun has thought of another layout in between
        return b""


def stand_still(client: ViewerClient, deadline: float) -> None:
    """Pause, as soon as there is a moment to pause at."""
    while True:
        try:
            client.set_time(play_state="paused")
        except ConnectionError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)
        else:
            return


def of_command(session: Path) -> tuple[float, float, float]:
    """``undulog view``: view, whole picture, and all of the session, each after so many seconds."""
    start = time.monotonic()
    command = [sys.executable, "-c", VIEW, "view", str(session)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        had_s, whole_s = look(process.stdout.readline().strip(), start)
        line = process.stdout.readline()
        if "all of it" not in line:
            sys.exit(f"undulog view ended early: {line}")
        return had_s, whole_s, time.monotonic() - start
    finally:
        process.terminate()
        process.wait()


def of_viewer(file: Path) -> tuple[float, float]:
    """Open a file in Rerun's viewer: view and whole picture, each after so many seconds."""
    start = time.monotonic()
    with ExitStack() as stack:
        _, address = start_viewer(stack, file, "--headless", SIZE)
        return look(address, start)


def measure(log: Path, recording: Path) -> bool:
    """Open and print; whether the bar is met."""
    print(f"{log.stat().st_size / 1e6:.0f} MB of MCAP")
    start = time.monotonic()
    with Session.open(log) as session:
        write_recording(session, recording)
    print(f"converted once in {time.monotonic() - start:.1f} s")
    ours, itself, before = list[float](), list[float](), list[float]()
    for _ in range(3):
        had_s, whole_s, all_s = of_command(log)
        ours.append(whole_s)
        print(f"undulog view: view after {had_s:.2f} s, all of it after {all_s:.1f} s", flush=True)
        itself.append(of_viewer(log)[1])
        before.append(of_viewer(recording)[1])
    rerun = versions("rerun-sdk")
    minutes = f"first whole picture of {log.stat().st_size / 1e6:.0f} MB of MCAP"
    good = compared(minutes, ours, itself, f"{rerun} on the MCAP itself", bar=BAR)
    compared(minutes, ours, before, f"{rerun} on a recording converted before")
    return good


def main(what: str) -> None:
    """Write if need be, open, print."""
    with tempfile.TemporaryDirectory() as folder:
        log, recording = Path(folder) / "bench.mcap", Path(folder) / "bench.rrd"
        if what.endswith(".mcap"):
            log = Path(what)
        else:
            write_hour(log, round(float(what) * 60), can=False)
        good = measure(log, recording)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "60")
