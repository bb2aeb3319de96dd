"""An hour of the 25-joint snake converted for the viewer: time, size and memory, held to bars.

The session is that of ``hour_session.py``: 25 joints at 100 Hz, each sampled at a time of its own,
with currents, voltages, temperatures, 16 distance sensors, odometry and gait, noise and the parts'
resolution; ``--can`` adds the raw frames, which are read past. It is converted by
``write_recording`` in a process of its own, and by ``undulog view --save``, which analyses it
first; the two are compared on one core, in turn, ``--pairs`` times. Peak memory is the largest
resident set, mapped file included; the file is in the page cache, and the best of several runs
counts. Processor time, all threads, is printed beside: other processes disturb it less.

The peer is what one writes first: every sample of every joint, and every pose of the body, by a
``log`` call of its own, on the same two timelines. It takes ``--rows`` seconds of the session, and
its figures are scaled to the whole, which suits it: nothing in it gets slower with time.

Run: python bench/replay_convert.py [--minutes 60] [--runs 2] [--pairs 9] [--can] [--rows 20]
     [--folder DIR | --keep FILE]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
from analyse_hour import cost
from measuring import (
    PEAK_MIB,
    add_place,
    arguments,
    command_took,
    hour_of,
    in_turn,
    took,
)  # fmt: skip
from records import compared, verdict, versions

from undulog.capture import Session
from undulog.replay.draw.body import capsule_poses, capsule_shape
from undulog.replay.draw.motion import assemble, frames_of, read_head
from undulog.replay.samples.quantities import quantities
from undulog.replay.samples.tracks import read_columns, wanted_fields
from undulog.replay.viewer import viewer_binary

COST, SIZE, PEAK_MB = 0.1, 0.5, 500.0
WITH_ANALYSIS = 1.4
"""The bars; memory is not to grow with the session."""

CONVERT = f"""
import json, sys, time
from pathlib import Path
start = time.perf_counter()
from undulog.capture import Session
from undulog.replay import write_recording
with Session.open(sys.argv[1]) as session:
    write_recording(session, Path(sys.argv[2]))
took, used_s = time.perf_counter() - start, time.process_time()
print(json.dumps([took, used_s, {PEAK_MIB} * 1.048576]))
"""


class Figures(NamedTuple):
    """Cost of a conversion.

    Attributes:
        wall_s: From start to end, imports included.
        processor_s: User and system time, all threads.
        peak_mb: Largest resident memory.
        size_mb: Of the recording.
    """

    wall_s: float
    processor_s: float
    peak_mb: float
    size_mb: float


def converted(session: Path, recording: Path) -> Figures:
    """Convert in a process of its own."""
    command = [sys.executable, "-c", CONVERT, str(session), str(recording)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    wall_s, processor_s, peak_mb = json.loads(done.stdout.splitlines()[-1])
    return Figures(wall_s, processor_s, peak_mb, recording.stat().st_size / 1e6)


def converted_by_command(session: Path, recording: Path) -> Figures:
    """Convert by the command line, which analyses first."""
    spent, peak_mib = cost("view", session, "--save", recording, "--force")
    return Figures(*spent, peak_mib * (1 << 20) / 1e6, recording.stat().st_size / 1e6)


@contextmanager
def one_core() -> Iterator[None]:
    """Keep what is started to one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def rerun_itself(path: Path, recording: Path) -> float:
    """Convert the MCAP file by Rerun's own reader; return the processor time [s]."""
    command = [viewer_binary(), "mcap", "convert", path, "-o", recording]
    return command_took(*command, stderr=subprocess.DEVNULL).processor_s


def row_by_row(path: Path, seconds: float, recording: Path) -> Figures:
    """Convert the beginning of the session by a log call for each sample."""
    with Session.open(path) as session:
        start_ns = session.start_ns
        stop_ns = start_ns + round(seconds * 1e9)
        columns_of = {
            topic: names for topic, names in wanted_fields(session).items() if topic != "/gait"
        }
        columns = read_columns(session, columns_of, start_ns=start_ns, stop_ns=stop_ns)
        robot = session.robot
        assert robot is not None
        measured = columns["/joint_states", "position"]
        head, _ = frames_of(read_head(session, robot, measured, []), session.end_ns)
        rows = slice(0, int(np.searchsorted(head.t_ns, stop_ns)))
        motion = assemble(robot, head.at(rows), columns)
    lengths, radii = capsule_shape(robot)
    samples = [
        (int(t_ns), f"{entity}/{track.name}", value)
        for entity, tracks in quantities(columns).items()
        for track in tracks
        for t_ns, value in zip(track.t_ns.tolist(), track.values.tolist(), strict=True)
    ]
    every = slice(None)
    origin, turn = capsule_poses(robot, *motion.links(every))
    assert motion.commands is not None
    asked_origin, asked_turn = capsule_poses(robot, *motion.links(every, motion.commands))
    rec = rr.RecordingStream("rows", send_properties=False)
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    rec.save(recording)

    def stand_at(t_ns: int) -> None:
        rec.set_time("session_time", duration=np.timedelta64(t_ns - start_ns, "ns"))
        rec.set_time("gait_cycle", duration=np.timedelta64((t_ns - start_ns) // 2, "ns"))

    def log() -> None:
        for t_ns, entity, value in samples:
            stand_at(t_ns)
            rec.log(entity, rr.Scalars(value))
        for i, t_ns in enumerate(motion.t_ns.tolist()):
            stand_at(t_ns)
            for entity, at, way in (
                ("/world/measured", origin[i], turn[i]),
                ("/world/commanded", asked_origin[i], asked_turn[i]),
            ):
                shape = rr.Capsules3D(
                    lengths=lengths, radii=radii, translations=at, quaternions=way
                )
                rec.log(entity, shape)
        rec.disconnect()

    return Figures(*took(log), 0.0, recording.stat().st_size / 1e6)


def measure(path: Path, minutes: float, runs: int, pairs: int, rows_s: float) -> bool:
    """Convert and print; whether all bars are met."""
    recording = path.with_name("bench.rrd")
    print(f"{minutes:g} min, 25 joints at 100 Hz, {path.stat().st_size / 1e6:.0f} MB of MCAP")
    scale = minutes * 60 / rows_s
    conversion = partial(converted, path, recording)
    command = partial(converted_by_command, path, recording)
    ours, commands, rows, itself = in_turn(
        runs,
        conversion,
        command,
        partial(row_by_row, path, rows_s, recording),
        partial(rerun_itself, path, recording),
    )
    rerun = versions("rerun-sdk")
    by_row = f"{rerun}, a log call for each sample (scaled from {rows_s:g} s)"
    peer = f"{rerun} mcap convert of the MCAP, nothing derived"
    rows_cpu = [row.processor_s for row in rows]
    good = list[bool]()
    for what, costs in (("MCAP to .rrd", ours), ("view --save, which analyses", commands)):
        cpu = [figures.processor_s for figures in costs]
        good.append(compared(what, cpu, rows_cpu, by_row, bar=COST, scale=scale))
        compared(what, cpu, itself, peer)
        peak_mb = max(figures.peak_mb for figures in costs)
        good.append(verdict(f"{what}, peak memory", peak_mb, PEAK_MB, "MB"))
    with one_core():
        spent = in_turn(pairs, lambda: command().processor_s, lambda: conversion().processor_s)
    what, alone = "view --save, which analyses, on one core", "the conversion alone"
    good.append(compared(what, *spent, alone, bar=WITH_ANALYSIS))
    verdict("MCAP to .rrd, wall-clock time", min(figures.wall_s for figures in ours), None, "s")
    sizes = [ours[0].size_mb], [rows[0].size_mb]
    good.append(compared(".rrd, size", *sizes, by_row, bar=SIZE, unit="MB", scale=scale))
    recording.unlink()
    return all(good)


def main() -> None:
    """Write, measure, print."""
    parser = arguments(__doc__, minutes=60.0, runs=2, pairs=9)
    parser.add_argument("--can", action="store_true", help="with raw frames, 8,000 a second")
    parser.add_argument("--rows", type=float, default=20.0, help="what the peer takes [s]")
    add_place(parser, "2 GB")
    options = parser.parse_args()
    with hour_of(options, can=options.can) as (path, seconds):
        good = measure(path, seconds / 60, options.runs, options.pairs, options.rows)
    sys.exit(not good)


if __name__ == "__main__":
    main()
