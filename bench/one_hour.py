"""An hour of the 25-joint snake, written and read: size, load time, memory, window, peers.

Every figure is a ratio to a named peer on the same file, or a size, and is held against its bar.
Times are processor time of this process, one thread each, the file in the page cache, the median
of several runs in turn; other processes disturb the ratios less than the times.

Load: all joint, time, power and sensor columns in one pass, against decompressing each chunk of
the file (they lie in all of them) and dropping it, with the same zstandard library.

Run: python bench/one_hour.py [--minutes 60] [--runs 3] [--folder DIR]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import zstandard
from hour_session import BUS, EPOCH_NS, JOINT_TOPICS, write_session
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from capture import Session
from capture.console import progress
from capture.log.signals import JointSignals

Loaded = tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]

MIB = 1 << 20
HOUR_S = 3600
PEER_S = 30
"""Seconds of the session that the slow peer reads."""

AXES = ("x", "y", "z")


def sensor_fields(session: Session) -> dict[str, list[str]]:
    """What the sensors measure, by topic."""
    fields = {topic: ["range"] for topic in session.channels if topic.startswith(("/ir/", "/son"))}
    fields["/imu"] = [f"linear_acceleration.{axis}" for axis in AXES]
    fields["/compass"] = [f"magnetic_field.{axis}" for axis in AXES]
    return fields


def cpu_s(work: Callable[[], object]) -> float:
    """Processor time of a piece of work [s]; what it gives is dropped within that time."""
    start = time.process_time()
    work()
    return time.process_time() - start


def inflate_all_s(path: Path) -> float:
    """The reference: decompress each chunk and drop it; processor time [s], opening left out."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    places = [
        (chunk.chunk_start_offset, chunk.uncompressed_size) for chunk in summary.chunk_indexes
    ]
    data = np.memmap(path, mode="r")
    start = time.process_time()
    decompressor = zstandard.ZstdDecompressor()
    for at, size in places:
        head = at + 9 + 8 + 8 + 8 + 4  # times, size, CRC; then the name of the compression
        name = int.from_bytes(data[head : head + 4].tobytes(), "little")
        begin = head + 4 + name
        length = int.from_bytes(data[begin : begin + 8].tobytes(), "little")
        decompressor.decompress(data[begin + 8 : begin + 8 + length], max_output_size=size)
    return time.process_time() - start


def load(path: Path) -> Loaded:
    """All columns but those of the bus and of what is only looked at."""
    with Session.open(path) as session:
        return session.columns(JOINT_TOPICS, sensor_fields(session))


def load_frames(path: Path) -> object:
    """All raw frames."""
    with Session.open(path) as session:
        return session.frames(BUS)


def rates(path: Path, window: tuple[int, int]) -> tuple[float, float]:
    """Seconds a message of our reader (all of the session) and of the peer (a window of it)."""
    topics = [*JOINT_TOPICS, "/joint_sample_offset", "/joint_command_offset"]  # ours needs them too
    with Session.open(path) as session:
        count = sum(session.channels[topic].count for topic in topics)
    ours = statistics.median(cpu_s(lambda: _joints(path)) for _ in range(3)) / count
    read = 0
    start = time.process_time()
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _ in reader.iter_decoded_messages(
            topics=topics, starting_at=window[0], ending_before=window[1]
        ):
            read += 1
    return ours, (time.process_time() - start) / read


def _joints(path: Path) -> object:
    with Session.open(path) as session:
        return session.joint_columns(JOINT_TOPICS)


def window_ms(path: Path, start_s: int) -> tuple[float, float]:
    """Ten seconds of joint states from an open session: wall-clock, first and later windows."""
    took: list[float] = []
    with Session.open(path) as session:
        for k in range(8):
            start_ns = EPOCH_NS + (start_s + 11 * k) * 10**9
            begin = time.perf_counter()
            session.joint_columns(
                {"/joint_states": ["position", "velocity", "effort"]},
                start_ns=start_ns,
                stop_ns=start_ns + 10 * 10**9,
            )
            took.append((time.perf_counter() - begin) * 1e3)
    return took[0], statistics.median(took[1:])


def memory(path: Path) -> dict[str, int]:
    """Peak of a fresh process while it loads: beyond the arrays and the mapped file [byte]."""
    clear = Path("/proc/self/clear_refs")
    load_some = path.with_name("warm.mcap")
    write_session(load_some, 2, can=True)
    load(load_some)  # what is imported late is imported now
    load_some.unlink()
    clear.write_text("5")  # the high-water mark begins anew
    before = _status("VmRSS")
    found = load(path)
    peak = _status("VmHWM")
    arrays = sum(_sizes(found).values())
    return {"arrays": arrays, "over": peak - before - arrays - path.stat().st_size}


def _sizes(found: Loaded) -> dict[int, int]:
    """Memory of the arrays that were loaded, each counted once, by address."""
    joints, tables = found
    sizes: dict[int, int] = {}
    for signals in joints.values():
        for array in (*signals.t_ns, *signals.values):
            sizes[array.ctypes.data] = array.nbytes
    for table in tables.values():
        for column in (table.index, *(table[name] for name in table)):
            array = column.to_numpy()
            sizes[array.ctypes.data] = array.nbytes
    return sizes


def _status(key: str) -> int:
    """A figure of this process's memory [byte]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024
    raise KeyError(key)


def verdict(what: str, value: float, bar: float, unit: str, *, most: bool = True) -> bool:
    """Print a figure beside its bar."""
    good = value <= bar if most else value >= bar
    sign = "at most" if most else "at least"
    print(f"{'PASS' if good else 'FAIL'}  {what}: {value:.2f} {unit} (bar: {sign} {bar:g} {unit})")
    return good


def make(path: Path, seconds: int, *, can: bool) -> None:
    """Write a session, with a progress bar."""
    with progress(f"Writing {path.name}", total=float(seconds)) as told:
        write_session(path, seconds, can=can, progress=lambda done: told.update(float(done)))


def measure(path: Path, without: Path, seconds: int, runs: int) -> bool:
    """Measure all and print; whether all bars are met."""
    part = HOUR_S / seconds
    good = [
        verdict("an hour with raw frames", path.stat().st_size * part / 1e6, 850, "MB"),
        verdict("an hour without", without.stat().st_size * part / 1e6, 550, "MB"),
    ]
    load(path)  # memory that was never used costs more the first time, file pages too
    inflated: list[float] = []
    loaded: list[float] = []
    frames: list[float] = []
    for _ in range(runs):
        inflated.append(inflate_all_s(path))
        loaded.append(cpu_s(lambda: load(path)))
        frames.append(cpu_s(lambda: load_frames(path)))
    reference = statistics.median(inflated)
    print(f"      decompress each chunk and drop it: {reference:.2f} s")
    ratio = statistics.median(loaded) / reference
    good.append(verdict("load joint, time, power and sensor columns", ratio, 2.0, "x that"))
    print(f"      load the raw frames: {statistics.median(frames) / reference:.2f} x that")
    command = [sys.executable, __file__, "--memory", str(path)]
    told = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    print(f"      arrays: {told['arrays'] / 1e6:.0f} MB")
    good.append(verdict("beyond arrays and mapped file", told["over"] / MIB, 64, "MiB"))
    first, later = window_ms(path, seconds // 3)
    print(f"      first window of an open session: {first:.1f} ms")
    good.append(verdict("ten seconds of joint states", later, 10, "ms"))
    middle = EPOCH_NS + seconds // 2 * 10**9
    ours, peer = rates(path, (middle, middle + min(PEER_S, seconds // 2) * 10**9))
    print(f"      JointState: ours {ours * 1e6:.2f} us a message, peer {peer * 1e6:.1f} us")
    good.append(verdict("mcap + mcap-ros2-support", peer / ours, 50, "x our time", most=False))
    return all(good)


def main() -> None:
    """Write, measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="a folder with 2 GB to spare")
    parser.add_argument("--memory", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory is not None:
        print(json.dumps(memory(options.memory)))
        return
    seconds = max(round(options.minutes * 60), 60)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path, without = Path(folder) / "with-frames.mcap", Path(folder) / "without.mcap"
        make(path, seconds, can=True)
        make(without, seconds, can=False)
        good = measure(path, without, seconds, options.runs)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
