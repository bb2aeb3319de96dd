"""Recorders of other makes, on the same socketcand buses: what they cost and what they lose.

``python bench/peer_recorder.py blf|candump|mcap-ros2 OUT PORT...`` records until SIGTERM. The
first two are python-can's own Logger behind its Notifier; the third writes one can_msgs/Frame a
frame with mcap-ros2-support, as a ROS 2 recorder would. The last line of the output is a JSON
object: frames written, and seconds of processor time.
"""

from __future__ import annotations

import itertools
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import can
from mcap_ros2.writer import Writer

from undulog.capture.exchange.formats.can_msgs import SCHEMA, TYPE_NAME


class Ros2Listener(can.Listener):
    """One message a frame."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        self._stream = path.open("wb")
        self._writer = Writer(self._stream)
        self._schema = self._writer.register_msgdef(TYPE_NAME, SCHEMA)
        self._lock = threading.Lock()

    def on_message_received(self, msg: can.Message) -> None:
        """Write one frame."""
        t_ns = round(msg.timestamp * 1e9)
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        frame = {
            "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""},
            "id": msg.arbitration_id,
            "is_rtr": msg.is_remote_frame,
            "is_extended": msg.is_extended_id,
            "is_error": msg.is_error_frame,
            "dlc": msg.dlc,
            "data": list(bytes(msg.data).ljust(8, b"\0")),
        }
        with self._lock:
            self._writer.write_message("/can", self._schema, frame, time.time_ns(), t_ns)

    def stop(self) -> None:
        """Finalise."""
        self._writer.finish()
        self._stream.close()


def _count(frames: Iterator[int], _msg: can.Message) -> None:
    next(frames)


def main() -> None:
    """Record until SIGTERM."""
    kind, out, ports = sys.argv[1], Path(sys.argv[2]), [int(port) for port in sys.argv[3:]]
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    buses = [
        can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel=f"can{k}")
        for k, port in enumerate(ports)
    ]
    suffix = {"blf": ".blf", "candump": ".log"}.get(kind)
    if suffix is None:
        listener = Ros2Listener(out.with_suffix(".mcap"))
    else:
        listener = can.Logger(str(out.with_suffix(suffix)))
    # A function has no stop(): the listener is of several notifiers, each of which would call it.
    counts = [itertools.count() for _ in buses]
    notifiers = [
        can.Notifier(bus, [listener.on_message_received, partial(_count, count)], timeout=0.2)
        for bus, count in zip(buses, counts, strict=True)
    ]
    print("ready", flush=True)
    ended.wait()
    time.sleep(0.5)
    for notifier in notifiers:
        notifier.stop(timeout=5)
    listener.stop()
    for bus in buses:
        bus.shutdown()
    result = {"frames": sum(map(next, counts)), "cpu_s": time.process_time()}
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
