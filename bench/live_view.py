"""What a live view costs the recorder: offering a message and the tick's pump.

The same messages, 25 joints at the log contract's rates, are offered in real time in ticks of
5 ms: to nobody, to a relay that draws to a file, to the same relay frozen, and to a relay whose
viewer, Rerun's own gRPC server, is frozen. Printed are the cost of a message (tap and pump
together, mean), of an offer alone, and of a pump (median, 99th percentile, largest); all as a
recorder meets them, with the caches gone cold between ticks. First, an offer in a tight loop.

Run: python bench/live_view.py [--seconds 20]  # of each case
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from mcap.records import Channel, Metadata, Schema
from measuring import arguments, start, wait_for
from records import verdict

from undulog.capture import load_robot
from undulog.capture.log.messages.cdr import encode, layout_of
from undulog.capture.log.messages.definitions import message_type, schema_text
from undulog.capture.recorder.live_feed import LiveFeed
from undulog.replay.viewer import LOOPBACK, free_ports, viewer_binary

TICK_S = 0.005
RATE_HZ = 100
TOPICS = tuple(f"/joint_{w}" for w in ["commands", "states", "current", "voltage", "temperature"])
ROBOT = load_robot("snake25")

Message = tuple[int, int, int, int, bytes]


def define(feed: LiveFeed) -> None:
    """Define the messages of a feed."""
    name = "sensor_msgs/msg/JointState"
    facts = {"session_id": f"bench-{os.urandom(4).hex()}", "epoch_ns": "1735689600000000000"}
    feed.define(Metadata(name="undulog", metadata=facts))
    feed.define(Schema(id=1, name=name, encoding="ros2msg", data=schema_text(name).encode()))
    for number, topic in enumerate(TOPICS, start=1):
        metadata = {"unit": "rad"}
        feed.define(Channel(number, topic, "cdr", metadata, 1))


def sample(number: int) -> list[Message]:
    """Return the messages of one round of the bus, all with the same values."""
    t_ns = 1_735_689_600_000_000_000 + number * 1_000_000_000 // RATE_HZ
    view = np.frombuffer(TEMPLATE, dtype="<f8", count=25, offset=LAYOUT.leaves["position"].offset)
    view[:] = np.sin(number * 0.03 - np.arange(25) / 3.0)
    sec, nanosec = divmod(t_ns, 1_000_000_000)
    stamp = LAYOUT.leaves["header.stamp.sec"].offset
    TEMPLATE[stamp : stamp + 8] = sec.to_bytes(4, "little") + nanosec.to_bytes(4, "little")
    payload = bytes(TEMPLATE)
    return [(k, t_ns, t_ns, number, payload) for k in range(1, len(TOPICS) + 1)]


_KIND = message_type("sensor_msgs/msg/JointState")
_VALUES = dict.fromkeys(("position", "velocity", "effort"), [0.0] * 25)
TEMPLATE = bytearray(encode(_KIND, {"name": list(ROBOT.joint_names), **_VALUES}))
LAYOUT = layout_of(_KIND, bytes(TEMPLATE))


_rounds = itertools.count()


def measure(feed: LiveFeed, seconds: float, label: str) -> None:
    """Offer and pump in real time, and print what it cost."""
    offers: list[int] = []
    pumps: list[int] = []
    count = 0
    clock = time.perf_counter_ns
    start = time.perf_counter()
    ticks = round(seconds / TICK_S)
    before = feed.counts.sent, feed.counts.dropped
    for tick in range(ticks):
        messages = sample(next(_rounds)) if tick % 2 == 0 else []
        begun = clock()
        for message in messages:
            feed.offer(*message)
        offered = clock()
        feed.pump()
        pumps.append(clock() - offered)
        if messages:
            offers.append((offered - begun) // len(messages))
            count += len(messages)
        time.sleep(max(start + (tick + 1) * TICK_S - time.perf_counter(), 0.0))
    pump = np.array(pumps) / 1e3
    p50, p99 = np.percentile(pump, [50, 99])
    mean = (sum(offers) * len(TOPICS) + sum(pumps)) / count / 1e3
    verdict(f"live feed, {label}: cost a message", mean, None, "us")
    sent, dropped = feed.counts.sent - before[0], feed.counts.dropped - before[1]
    print(
        f"{label:28s} {mean:6.2f} us a message; offer {np.median(offers) / 1e3:5.2f} us; pump "
        f"{p50:5.1f} / {p99:6.1f} / {pump.max():6.1f} us; {ticks} of {ticks} ticks; "
        f"sent {sent}, dropped {dropped}",
        flush=True,
    )


def measure_hot(feed: LiveFeed, count: int = 200_000) -> None:
    """Offer in a tight loop, and print what it cost."""
    (message, *_) = sample(next(_rounds))
    begun = time.perf_counter_ns()
    for _ in range(count):
        feed.offer(*message)
    offer_us = (time.perf_counter_ns() - begun) / count / 1e3
    print(f"{'nobody watches, tight loop':28s} {offer_us:6.2f} us an offer")


def relay(stack: ExitStack, path: Path, *options: object) -> subprocess.Popen[str]:
    """Start a relay in a process of its own; it is ready."""
    view = (sys.executable, "-m", "undulog", "view", "--live", path)
    process = start(stack, *view, *options, stdout=None)
    wait_for(path.is_socket)
    return process


def start_viewer(stack: ExitStack, *options: object) -> tuple[subprocess.Popen[str], str]:
    """Start Rerun's viewer; return it and its address."""
    (port,) = free_ports(1)
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    place = ("--bind", LOOPBACK, "--port", port)
    viewer = start(stack, viewer_binary(), *options, *place, **silent)
    return viewer, f"rerun+http://{LOOPBACK}:{port}/proxy"


def connect(feed: LiveFeed) -> None:
    """Wait until the feed has found its relay."""

    def connected() -> bool:
        feed.pump()
        return feed.connected

    wait_for(connected)


def main() -> None:
    """Measure all cases."""
    seconds: float = arguments(__doc__, seconds=20.0).parse_args().seconds
    with tempfile.TemporaryDirectory(prefix="undulog-bench-") as folder:
        path = Path(folder) / "live.sock"
        feed = LiveFeed(path)
        define(feed)
        measure_hot(feed)
        measure(feed, seconds, "nobody watches")
        feed.close()

        with ExitStack() as stack:
            feed = LiveFeed(path)
            process = relay(stack, path, "--save", Path(folder) / "a.rrd", "--json")
            define(feed)
            connect(feed)
            measure(feed, seconds, "relay draws to a file")
            process.send_signal(signal.SIGSTOP)
            measure(feed, seconds, "relay frozen")
            process.send_signal(signal.SIGCONT)
            feed.close()
            process.wait()

        with ExitStack() as stack:
            server, address = start_viewer(stack, "--serve-grpc")
            feed = LiveFeed(path)
            stack.callback(feed.close)
            process = relay(stack, path, "--connect", address)
            define(feed)
            connect(feed)
            measure(feed, seconds, "relay draws in a viewer")
            server.send_signal(signal.SIGSTOP)
            measure(feed, seconds, "viewer frozen")
            server.kill()
            measure(feed, seconds, "viewer killed")
            process.terminate()
            process.wait()


if __name__ == "__main__":
    main()
