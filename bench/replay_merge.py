"""Time of bringing two converted sessions together, beside going row by row.

``python bench/replay_merge.py [MINUTES]`` writes the session of ``hour_session.py`` (25 joints at
100 Hz, each sampled at a time of its own, sensors, odometry and gait) twice, converts both, and
merges the two recordings three times as ``undulog view A B`` does: chunks get their session's name
in front, those of the second session are moved along both timelines, and all go into one file; then
all that the command does once both are converted, with the differences. Beside it the same
row by row, on a hundredth of the rows of every entity: each row is read from its recording and sent
by itself. And Rerun's own ``rerun rrd merge``, which puts no names in front and moves nothing. The
best of three runs counts; processor time is printed beside, since other processes disturb it less.
Ten minutes by default.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import rerun as rr
from hour_session import write_session
from measuring import in_turn
from records import compared, verdict, versions
from rerun.chunk import Chunk, LazyChunkStream

from undulog.capture import Session
from undulog.replay.overlay.sessions import Align, align, convert, read_side
from undulog.replay.overlay.write import Converted, chunks_of, send, write_overlay
from undulog.replay.viewer import viewer_binary

BAR = 4.0
"""For the merge of the two recordings, to Rerun's own merge, which moves and renames nothing."""

PART = 100


def streams(recordings: list[Path]) -> list[LazyChunkStream]:
    """Return the recordings' chunks under their names; the second one is moved."""
    return [
        chunks_of(path, f"/{name}", later_ns=k * 1_234_567_890, more_cycles=7 * k)
        for k, (name, path) in enumerate(zip(("robot", "twin"), recordings, strict=True))
    ]


def write(target: Path, fill: Callable[[rr.RecordingStream], None]) -> None:
    """Write one recording."""
    rec = rr.RecordingStream("undulog", recording_id="bench", send_properties=False)
    rec.save(target)
    fill(rec)
    rec.disconnect()


def some_rows(recordings: list[LazyChunkStream]) -> Iterable[Chunk]:
    """Every hundredth row of all chunks, a chunk each."""
    for chunk in (chunk for stream in recordings for chunk in stream.to_chunks()):
        batch = chunk.to_record_batch()
        for row in range(0, batch.num_rows, PART):
            yield from Chunk.from_record_batch(batch.slice(row, 1))


def rows(recordings: list[Path]) -> int:
    """Return how many rows there are in all."""
    return sum(chunk.num_rows for stream in streams(recordings) for chunk in stream.to_chunks())


def all_cpu_s() -> float:
    """Return the processor time of this process and its children that ended [s]."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def timed(what: str, work: Callable[[], object], target: Path) -> float:
    """Run it; print how long it took and return the processor time [s]."""
    wall, cpu = time.perf_counter(), all_cpu_s()
    work()
    wall, cpu = time.perf_counter() - wall, all_cpu_s() - cpu
    print(f"{what}: {wall:.2f} s, {cpu:.2f} s of CPU, {target.stat().st_size / 1e6:.0f} MB")
    return cpu


def convert_both(folder: Path, minutes: float) -> list[Converted]:
    """Write two sessions and convert them."""
    with ExitStack() as stack:
        logs = [folder / "robot.mcap", folder / "twin.mcap"]
        write_session(logs[0], round(minutes * 60), can=False)
        shutil.copy(*logs)
        sessions = [stack.enter_context(Session.open(log)) for log in logs]
        sides = [read_side(session, session.path.stem) for session in sessions]
        return [
            Converted(side, *convert(session, session.path.with_suffix(".rrd")))
            for side, session in zip(align(sides, Align.PHASE), sessions, strict=True)
        ]


def main(minutes: float) -> None:
    """Write, convert, merge, print."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        converted = convert_both(folder, minutes)
        recordings = [session.recording.path for session in converted]
        sizes = " and ".join(f"{path.stat().st_size / 1e6:.0f}" for path in recordings)
        count = rows(recordings)
        print(f"two sessions of {minutes:g} min, {sizes} MB of .rrd, {count} rows in all")
        target = folder / "merged.rrd"

        def merge() -> None:
            write(target, lambda rec: send(rec, streams(recordings)))

        rerun_merged = folder / "own.rrd"
        command = [viewer_binary(), "rrd", "merge", *recordings, "-o", rerun_merged]
        merge_by_rerun = partial(subprocess.run, command, check=True, capture_output=True)
        ours, theirs = in_turn(
            3,
            partial(timed, "merge", merge, target),
            partial(timed, "rerun rrd merge", merge_by_rerun, rerun_merged),
        )
        subprocess.run([viewer_binary(), "rrd", "verify", target], check=True, capture_output=True)
        overlay = partial(write_overlay, converted, target, Align.PHASE)
        title = "merge with views, differences and comparison"
        whole = [timed(title, overlay, target) for _ in range(3)]
        part = folder / "rows.rrd"
        slow = timed(
            f"row by row, every {PART}th row",
            lambda: write(part, lambda rec: rec.send_chunks(some_rows(streams(recordings)))),
            part,
        )
        rerun = versions("rerun-sdk")
        what = f"merge two recordings of {minutes:g} min"
        good = compared(what, ours, theirs, f"{rerun}, rrd merge", bar=BAR)
        compared(what, [min(ours)], [slow], f"{rerun}, row by row (scaled)", scale=PART)
        compared(f"{what}, with differences", whole, theirs, f"{rerun}, rrd merge")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        verdict(f"{what}, peak memory of all of it", peak, None, "MB")
        sys.exit(not good)


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
