"""How late a live view is: from a sample's own time to its being in the viewer, end to end.

A session of the twin (25 joints, all topics) goes in real time through the feed that a recorder
has, to ``undulog view --live`` in a process of its own, and to Rerun's viewer in a third, which
draws off screen. The viewer is asked, some sixty times a second, how far its data reach and where
its time cursor stands; what that is behind the clock is the lag, the asking included (about 13 ms,
printed). The first quarter is left out: the viewer builds its views then.

One bar applies to nine of ten lags: the others show when the machine's scheduler let the three
processes wait, so the load average is printed. The second bar applies to the median, less that of a
viewer fed directly: this process logs only the joints' positions, straight to a viewer. On a
machine without a graphics card the viewer draws in software and takes a core of its own.

Run: python bench/live_lag.py [--scenario weak-servo-pi3] [--size 1440x900]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import rerun as rr
from live_view import Message, connect, relay, start_viewer
from mcap.reader import make_reader
from measuring import arguments
from records import verdict, versions
from rerun.experimental import ViewerClient

from undulog.capture import Session
from undulog.capture.log.write.mcap_sink import Description
from undulog.capture.recorder.live_feed import LiveFeed
from undulog.replay.samples.timeline import SESSION_TIME
from undulog.replay.viewer import client_of

LAG_MS = 150.0
"""The bar: what ITU-T G.114 gives as the delay, one way, that hardly disturbs a conversation."""
DIRECT_MS = 50.0
"""The bar of the median beyond that of a viewer fed directly."""
TICK_NS = 5_000_000
LOOK_S = 0.003


class Watch(threading.Thread):
    """Polls the viewer for its position."""

    def __init__(self, client: ViewerClient, start_ns: int) -> None:
        """Begin to ask.

        Args:
            client: The viewer.
            start_ns: Monotonic time of the session's zero [ns].
        """
        super().__init__(daemon=True)
        self._client, self._start_ns = client, start_ns
        self.ending = threading.Event()
        self.data_ms: list[float] = []
        self.cursor_ms: list[float] = []
        self.asking_ms: list[float] = []

    def run(self) -> None:
        """Ask until told to end."""
        while not self.ending.wait(LOOK_S):
            asked = time.monotonic_ns()
            state = self._client.get_state()
            now = time.monotonic_ns()
            self.asking_ms.append((now - asked) / 1e6)
            for recording in state.recordings:
                for line in recording.timelines:
                    if line.name == SESSION_TIME and line.end:
                        self.data_ms.append((now - self._start_ns - line.end) / 1e6)
                if recording.current_timeline == SESSION_TIME and recording.current_time:
                    behind = now - self._start_ns - recording.current_time
                    self.cursor_ms.append(behind / 1e6)


def read(path: Path) -> tuple[list[Description], list[Message], int]:
    """Return the definitions of a session, its messages, and the Unix time of its zero [ns]."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        facts = list(reader.iter_metadata())
        definitions: list[Description] = [
            *facts,
            *summary.schemas.values(),
            *summary.channels.values(),
            *reader.iter_attachments(),
        ]
        messages = [
            (m.channel_id, m.log_time, m.publish_time, m.sequence, m.data)
            for _, _, m in reader.iter_messages()
        ]
    (epoch_ns,) = [
        metadata.metadata["epoch_ns"] for metadata in facts if metadata.name == "undulog"
    ]
    return definitions, messages, int(epoch_ns)


def send(feed: LiveFeed, messages: list[Message], epoch_ns: int, start_ns: int) -> None:
    """Offer messages when their time has come, in ticks of 5 ms as a recorder."""
    sent = tick = 0
    while sent < len(messages):
        now_ns = time.monotonic_ns() - start_ns
        while sent < len(messages) and messages[sent][1] - epoch_ns <= now_ns:
            feed.offer(*messages[sent])
            sent += 1
        feed.pump()
        tick += 1
        time.sleep(max(start_ns + tick * TICK_NS - time.monotonic_ns(), 0) * 1e-9)


def directly(session: Path, size: str) -> list[float]:
    """Log the positions of the joints to a viewer; return how late they are there [ms]."""
    with ExitStack() as stack:
        _, address = start_viewer(stack, "--headless", "--window-size", size)
        opened = stack.enter_context(Session.open(session))
        signals = opened.joints("/joint_states", "position")
        times_ns, rows = signals.t_ns[0] - opened.start_ns, np.transpose(signals.values)
        rec = rr.RecordingStream("undulog-bench")
        stack.callback(rec.disconnect)
        rec.connect_grpc(address)
        start_ns = time.monotonic_ns() + 200_000_000
        watch = Watch(client_of(address), start_ns)
        watch.start()
        for t_ns, row in zip(times_ns.tolist(), rows, strict=True):
            time.sleep(max(start_ns + t_ns - time.monotonic_ns(), 0) * 1e-9)
            rec.set_time(SESSION_TIME, duration=np.timedelta64(t_ns, "ns"))
            rec.log("/joints", rr.Scalars(row))
        watch.ending.set()
        watch.join()
    return watch.data_ms


def measure(session: Path, folder: Path, size: str) -> Watch:
    """Show a session as it is recorded."""
    path = folder / "live.sock"
    with ExitStack() as stack:
        _, address = start_viewer(stack, "--headless", "--window-size", size)
        relay(stack, path, "--connect", address)
        feed = LiveFeed(path)
        stack.callback(feed.close)
        client = client_of(address)
        definitions, messages, epoch_ns = read(session)
        for definition in definitions:
            feed.define(definition)
        connect(feed)
        start_ns = time.monotonic_ns() + 200_000_000
        watch = Watch(client, start_ns)
        watch.start()
        send(feed, messages, epoch_ns, start_ns)
        watch.ending.set()
        watch.join()
    return watch


def report(watch: Watch, direct_ms: list[float]) -> bool:
    """Print the lags; whether the bars are met."""
    good: list[bool] = []
    for what, values in (("in the viewer", watch.data_ms), ("at its cursor", watch.cursor_ms)):
        p50, p90, p99 = np.percentile(values[len(values) // 4 :], [50, 90, 99])
        name = f"live view, 90 % of the lags {what}"
        good.append(verdict(name, float(p90), LAG_MS, "ms", peer="ITU-T G.114, one way"))
        print(f"      lag {what}: median {p50:.0f}, 99 % within {p99:.0f} ms")
    ours, direct = (
        float(np.median(values[len(values) // 4 :])) for values in (watch.data_ms, direct_ms)
    )
    what = "live view, median lag beyond that of a viewer fed directly"
    good.append(verdict(what, ours - direct, DIRECT_MS, "ms", peer=versions("rerun-sdk")))
    print(f"      median lag of a viewer fed directly: {direct:.0f} ms")
    load, _, _ = os.getloadavg()
    asking = np.median(watch.asking_ms)
    print(f"      asking took {asking:.0f} ms; load average {load:.1f} on {os.cpu_count()} cores")
    return all(good)


def main() -> None:
    """Record a session of the twin, show it, print."""
    parser = arguments(__doc__)
    parser.add_argument("--scenario", default="weak-servo-pi3")
    parser.add_argument("--size", default="1440x900", help="of the viewer's window")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="undulog-bench-") as folder:
        session = Path(folder) / "run.mcap"
        run = ["sim", "run", options.scenario, "-o", str(session)]
        command = [sys.executable, "-m", "undulog", *run]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        direct_ms = directly(session, options.size)
        good = report(measure(session, Path(folder), options.size), direct_ms)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
