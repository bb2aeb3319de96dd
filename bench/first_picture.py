"""Time from starting the viewer to the first whole picture of a long session.

``python bench/first_picture.py [MINUTES]`` writes a session of 25 joints at 100 Hz (an hour by
default), converts it, and starts Rerun's viewer three times, without a window, on the recording;
then once on the MCAP file itself, which Rerun reads without us, as a peer. The first picture of the
recording is the body's, of the session itself the first view that Rerun makes of it. A picture is
whole when it is the one that the viewer still shows five seconds after it came to rest.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from replay_convert import write
from rerun.experimental import ViewerClient

from capture import Session
from replay import write_recording
from replay.viewer import LOOPBACK, free_ports, viewer_binary

REST_S = 5.0
PATIENCE_S = 600.0


def connect(address: str, deadline: float) -> ViewerClient:
    """Wait until the viewer answers."""
    while True:
        try:
            client = ViewerClient.connect(address)
            client.get_state()
        except (ConnectionError, RuntimeError, TimeoutError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)
        else:
            return client


def first_picture(file: Path, scene: str) -> tuple[float, float]:
    """Open a file and look until nothing changes any more.

    Args:
        file: The recording or session.
        scene: Class of the view to look at; the first view where there is none.

    Returns:
        Seconds until the viewer had this view, and until its picture was whole.
    """
    (port,) = free_ports(1)
    serve = ("--bind", LOOPBACK, "--port", str(port), "--window-size", "1440x900")
    start = time.monotonic()
    process = subprocess.Popen(
        [str(viewer_binary()), str(file), "--headless", *serve],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = start + PATIENCE_S
        client = connect(f"rerun+http://{LOOPBACK}:{port}/proxy", deadline)
        while not (views := client.get_state().views):
            if time.monotonic() > deadline:
                sys.exit(f"{file.name} doesn't show within {PATIENCE_S:g} s")
            time.sleep(0.02)
        had_s = time.monotonic() - start
        view = next((view for view in views if view.view_class == scene), views[0])
        client.set_time(play_state="paused")
        last, changed_s = b"", 0.0
        while time.monotonic() - start < changed_s + REST_S or client.get_state().loading:
            picture = client.take_screenshot(view.view_id)
            if picture != last:
                last, changed_s = picture, time.monotonic() - start
            if time.monotonic() > deadline:
                sys.exit(f"{file.name} isn't at rest within {PATIENCE_S:g} s")
        return had_s, changed_s
    finally:
        process.terminate()
        process.wait()


def main(minutes: float) -> None:
    """Write, convert, open, print."""
    with tempfile.TemporaryDirectory() as folder:
        log, recording = Path(folder) / "bench.mcap", Path(folder) / "bench.rrd"
        write(log, round(minutes * 60), can=False)
        start = time.monotonic()
        with Session.open(log) as session:
            write_recording(session, recording)
        print(
            f"{minutes:g} min, {log.stat().st_size / 1e6:.0f} MB of MCAP; "
            f"converted once in {time.monotonic() - start:.1f} s to "
            f"{recording.stat().st_size / 1e6:.0f} MB"
        )
        for name, file, times in (("recording", recording, 3), ("MCAP itself", log, 1)):
            for _ in range(times):
                had_s, whole_s = first_picture(file, "3D")
                print(f"{name}: view after {had_s:.2f} s, whole picture after {whole_s:.2f} s")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
