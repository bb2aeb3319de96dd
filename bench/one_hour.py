"""An hour of the 25-joint snake, written and read: size, load time, memory, window, peers.

Every figure is a ratio to a named peer on the same file, or a size, and is held against its bar;
the file is in the page cache, and the median of several runs in turn counts.

Load: all joint, time, power and sensor columns in one pass, against decompressing each chunk in
which any of them lies and dropping it, with the same zstandard library. One thread each, and
processor time, which other processes disturb less.

Window and JointStates: wall-clock time with as many threads as a session has by default, as who
asks for them waits for it; with one thread it is printed beside. The peer has one thread.

Run: python bench/one_hour.py [--minutes 60] [--runs 3] [--folder DIR]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import zstandard
from hour_session import BUS, EPOCH_NS, JOINT_TOPICS, write_session
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from measuring import HOUR_S, arguments, in_turn, memory, took
from records import compared, verdict, versions

from undulog.capture import Session
from undulog.capture.common.console import progress
from undulog.capture.common.process import threads_or_default
from undulog.capture.log.read.joint_states import OFFSET_TOPICS
from undulog.capture.log.read.sample_times import JointSignals

Loaded = tuple[dict[tuple[str, str], JointSignals], dict[str, pd.DataFrame]]

MIB = 1 << 20
PEER_S = 30
"""Seconds of the session that the slow peer reads."""
LATER_WINDOWS = 7
WINDOW_BAR = 1 / 10

AXES = ("x", "y", "z")
OWN_TIMES = tuple(sorted({*OFFSET_TOPICS.values()}))
"""Ours reads them too: when each joint of a message was sampled or commanded."""


def sensor_fields(session: Session) -> dict[str, list[str]]:
    """Return the fields of the sensors by topic."""
    fields = {topic: ["range"] for topic in session.channels if topic.startswith(("/ir/", "/son"))}
    fields["/imu"] = [f"linear_acceleration.{axis}" for axis in AXES]
    fields["/compass"] = [f"magnetic_field.{axis}" for axis in AXES]
    return fields


def topics_loaded(path: Path) -> set[str]:
    """Return the topics that :func:`load` reads."""
    with Session.open(path) as session:
        return {*JOINT_TOPICS, *OWN_TIMES, *sensor_fields(session)}


def inflate_s(path: Path, topics: Collection[str]) -> float:
    """Return the reference: the time of decompressing each chunk with one of some topics [s].

    It is processor time, opening left out.
    """
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    ids = {key for key, channel in summary.channels.items() if channel.topic in topics}
    places = [
        (chunk.chunk_start_offset, chunk.uncompressed_size)
        for chunk in summary.chunk_indexes
        if not ids.isdisjoint(chunk.message_index_offsets)
    ]
    data = np.memmap(path, mode="r")

    def inflate() -> None:
        decompressor = zstandard.ZstdDecompressor()
        for at, size in places:
            head = at + 9 + 8 + 8 + 8 + 4  # times, size, CRC; then the name of the compression
            name = int.from_bytes(data[head : head + 4].tobytes(), "little")
            begin = head + 4 + name
            length = int.from_bytes(data[begin : begin + 8].tobytes(), "little")
            decompressor.decompress(data[begin + 8 : begin + 8 + length], max_output_size=size)

    return took(inflate).processor_s


def load(path: Path, threads: int | None) -> Loaded:
    """Return all columns but those of the bus and of what is only looked at."""
    with Session.open(path, threads=threads) as session:
        return session.columns(JOINT_TOPICS, sensor_fields(session))


def load_frames(path: Path) -> object:
    """Return all raw frames."""
    with Session.open(path, threads=1) as session:
        return session.frames(BUS)


def message_times(
    path: Path, window: tuple[int, int], threads: Sequence[int], runs: int
) -> tuple[list[list[float]], list[float]]:
    """Return wall-clock times a message, turn by turn [us]: ours by threads, and the peer's.

    Ours reads the whole session, the peer a window of it [Unix ns], half-open.
    """
    topics = [*JOINT_TOPICS, *OWN_TIMES]
    with Session.open(path) as session:
        count = sum(session.channels[topic].count for topic in topics)
    read = 0

    def ours(number: int) -> None:
        with Session.open(path, threads=number) as session:
            session.joint_columns(JOINT_TOPICS)

    def peer() -> None:
        nonlocal read
        read = decode(path, topics, window)

    works = [*(partial(ours, number) for number in threads), peer]
    *by_threads, theirs = in_turn(runs, *(partial(took, work) for work in works))
    ours_us = [[1e6 * cost.wall_s / count for cost in turns] for turns in by_threads]
    return ours_us, [1e6 * cost.wall_s / read for cost in theirs]


def decode(path: Path, topics: Sequence[str], window: tuple[int, int]) -> int:
    """Decode the messages of a half-open window [Unix ns] as the peer does; return how many."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = reader.iter_decoded_messages(
            topics=topics, starting_at=window[0], ending_before=window[1]
        )
        return sum(1 for _ in messages)


def window_ms(path: Path, start_s: int, threads: int) -> tuple[float, float]:
    """Return wall-clock times of the first and later windows of ten seconds [ms]."""
    times: list[float] = []
    fields = {"/joint_states": ["position", "velocity", "effort"]}
    with Session.open(path, threads=threads) as session:
        for k in range(LATER_WINDOWS + 1):
            start_ns = EPOCH_NS + (start_s + 11 * k) * 10**9
            window = {"start_ns": start_ns, "stop_ns": start_ns + 10 * 10**9}
            read = partial(session.joint_columns, fields, **window)
            times.append(took(read).wall_s * 1e3)
    return times[0], statistics.median(times[1:])


def loading_memory(path: Path) -> dict[str, int]:
    """Peak of a fresh process while it loads [byte]: beyond the arrays and the mapped file."""
    load_some = path.with_name("warm.mcap")
    write_session(load_some, 2, can=True)
    load(load_some, None)  # what is imported late is imported now
    load_some.unlink()
    before, peak, done = memory("RssAnon"), 0, threading.Event()

    def watch() -> None:  # what is mapped of the file is not in this figure
        nonlocal peak
        while not done.wait(0.001):
            peak = max(peak, memory("RssAnon"))

    watcher = threading.Thread(target=watch)
    watcher.start()
    loaded = load(path, None)
    done.set()
    watcher.join()
    arrays = sum(_sizes(loaded).values())
    return {"arrays": arrays, "over": max(peak, memory("RssAnon")) - before - arrays}


def _sizes(loaded: Loaded) -> dict[int, int]:
    """Return memory of the arrays that were loaded, each counted once, by address."""
    joints, tables = loaded
    arrays = [array for series in joints.values() for array in (*series.t_ns, *series.values)]
    for table in tables.values():
        arrays += [column.to_numpy() for column in (table.index, *(table[name] for name in table))]
    return {array.ctypes.data: array.nbytes for array in arrays}


def make(path: Path, seconds: int, *, can: bool) -> None:
    """Write a session, with a progress bar."""
    with progress(f"Writing {path.name}", total=float(seconds)) as bar:
        write_session(path, seconds, can=can, progress=lambda done: bar.update(float(done)))


def measure(path: Path, without: Path, seconds: int, runs: int) -> bool:
    """Measure all and print; whether all bars are met."""
    part = HOUR_S / seconds
    good = [
        verdict("size of an hour with raw frames", path.stat().st_size * part / 1e6, 850, "MB"),
        verdict("size of an hour without", without.stat().st_size * part / 1e6, 550, "MB"),
    ]
    loaded_topics = topics_loaded(path)
    load(path, 1)  # memory that was never used costs more the first time, file pages too
    reference, loaded, frames = in_turn(
        runs,
        partial(inflate_s, path, loaded_topics),
        lambda: took(partial(load, path, 1)).processor_s,
        lambda: took(partial(load_frames, path)).processor_s,
    )
    peer = f"{versions('zstandard')}, decompressing the same chunks"
    what = "load joint, time, power and sensor columns, 1 thread"
    good.append(compared(what, loaded, reference, peer, bar=1.6))
    compared("load the raw frames, 1 thread", frames, reference, peer)
    threads = threads_or_default(None)
    command = [sys.executable, __file__, "--memory", str(path)]
    figures = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    print(f"      arrays: {figures['arrays'] / 1e6:.0f} MB")
    what = f"beyond arrays and mapped file, {threads} threads"
    good.append(verdict(what, figures["over"] / MIB, 64, "MiB"))
    peer = versions("mcap", "mcap-ros2-support")
    begin = EPOCH_NS + seconds // 3 * 10**9
    ten = begin, begin + 10 * 10**9
    windows, theirs = in_turn(
        runs,
        partial(window_ms, path, seconds // 3, threads),
        lambda: 1e3 * took(partial(decode, path, ["/joint_states"], ten)).wall_s,
    )
    first, later = zip(*windows, strict=True)
    print(f"      first window of an open session: {statistics.median(first):.1f} ms")
    what = f"ten seconds of joint states, {threads} threads"
    good.append(compared(what, later, theirs, peer, bar=WINDOW_BAR, unit="ms"))
    middle = EPOCH_NS + seconds // 2 * 10**9
    part = middle, middle + min(PEER_S, seconds // 2) * 10**9
    (alone, ours), theirs = message_times(path, part, (1, threads), runs)
    compared("a JointState message, 1 thread", alone, theirs, peer, unit="us")
    what = f"a JointState message, {threads} threads"
    good.append(compared(what, ours, theirs, peer, bar=1 / 50, unit="us"))
    return all(good)


def main() -> None:
    """Write, measure, print."""
    parser = arguments(__doc__, minutes=60.0, runs=3)
    parser.add_argument("--folder", type=Path, help="a folder with 2 GB to spare")
    parser.add_argument("--memory", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory is not None:
        print(json.dumps(loading_memory(options.memory)))
        return
    seconds = max(round(options.minutes * 60), 60)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path, without = Path(folder) / "with-frames.mcap", Path(folder) / "without.mcap"
        make(path, seconds, can=True)
        make(without, seconds, can=False)
        good = measure(path, without, seconds, options.runs)
    sys.exit(not good)


if __name__ == "__main__":
    main()
