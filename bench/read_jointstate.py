"""Reader speed: all JointState columns of a session, against mcap + mcap-ros2-support.

Both read the same file in the same run, the file in the page cache; the ratio of the medians of
wall-clock time is what counts, since machines differ. The peer has one thread, ours as many as a
session has by default, and one for comparison. The values are compared, so all did the work.
pybag-sdk and small-mcap are further peers where ``UNDULOG_BENCH_PYTHON`` names an interpreter that
has them; each runs in a process of its own (``foreign_reader.py``).

Run: python bench/read_jointstate.py [--minutes 5] [--runs 3]
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from foreign_reader import READERS
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from measuring import HERE, arguments, timed
from records import compared, not_run, versions

from undulog.capture import Session, SessionWriter
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.process import threads_or_default

PYTHON = "UNDULOG_BENCH_PYTHON"
BAR = 1 / 20
ONE_TOPIC = "/joint_states"
EPOCH_NS = 1_700_000_000_000_000_000
NAMES = [f"joint{i:02d}" for i in range(1, 26)]
TOPICS = {
    "/joint_commands": ("position",),
    "/joint_states": ("position", "velocity", "effort"),
    "/joint_current": ("position",),
    "/joint_voltage": ("position",),
}


def write_session(path: Path, minutes: float) -> int:
    """Write 25 joints at 100 Hz; returns the number of JointState messages."""
    rng = np.random.default_rng(1)
    ticks = round(minutes * 6000)
    with SessionWriter(path, session_id="bench", epoch_ns=EPOCH_NS) as writer:
        channels = {
            topic: writer.joint_state(
                topic, NAMES, unit="1", velocity="velocity" in fields, effort="effort" in fields
            )
            for topic, fields in TOPICS.items()
        }
        phase = np.arange(25) * 0.5
        for tick in range(ticks):
            t_ns = EPOCH_NS + tick * 10_000_000
            values = 0.4 * np.sin(tick * 0.03 - phase) + rng.normal(scale=1e-3, size=25)
            for topic, channel in channels.items():
                channel.write(t_ns, *(values,) * len(TOPICS[topic]))
    return ticks * len(TOPICS)


def read_ours(
    path: Path, threads: int, topics: Mapping[str, Sequence[str]] = TOPICS
) -> dict[str, FloatArray]:
    """Return all columns through the session reader."""
    with Session.open(path, threads=threads) as session:
        columns = session.joint_columns(topics)
    return {f"{topic}.{field}": np.array(columns[topic, field].values) for topic, field in columns}


def read_peer(path: Path) -> dict[str, FloatArray]:
    """Return the same columns through mcap and mcap-ros2-support, message by message."""
    rows: dict[str, list[list[float]]] = {
        f"{topic}.{field}": [] for topic, fields in TOPICS.items() for field in fields
    }
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=list(TOPICS)):
            for field in TOPICS[channel.topic]:
                rows[f"{channel.topic}.{field}"].append(getattr(message, field))
    return {name: np.array(values).T for name, values in rows.items()}


def main() -> None:
    """Write, read with each in turn, compare, print."""
    options = arguments(__doc__, minutes=5.0, runs=3).parse_args()
    threads = threads_or_default(None)
    peer = versions("mcap", "mcap-ros2-support")
    readers: dict[str, Callable[[Path], dict[str, FloatArray]]] = {
        f"{threads} threads": partial(read_ours, threads=threads),
        "1 thread": partial(read_ours, threads=1),
        peer: read_peer,
    }
    of_one_topic = partial(read_ours, threads=1, topics={ONE_TOPIC: TOPICS[ONE_TOPIC]})
    took: dict[str, list[float]] = defaultdict(list)
    library_versions: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        count = write_session(path, options.minutes)
        print(
            f"{count} JointState messages, {len(NAMES)} joints, {path.stat().st_size / 1e6:.0f} MB"
        )
        for _ in range(options.runs):  # in turn, so that a drift of the machine hits all
            read_by_all: list[dict[str, FloatArray]] = []
            for name, read in readers.items():
                used, columns = timed(partial(read, path))
                took[name].append(used.wall_s)
                read_by_all.append(columns)
            *ours, theirs = read_by_all
            for mine in ours:
                for name, values in mine.items():
                    np.testing.assert_array_equal(values, theirs[name])
            for library in READERS:
                if (read_by := foreign(library, path)) is not None:
                    assert read_by["messages"] == count // len(TOPICS), read_by
                    took[library].append(read_by["seconds"])
                    took[ours_to(library)].append(timed(partial(of_one_topic, path))[0].wall_s)
                    library_versions[library] = read_by["version"]
    what = "read all joint columns"
    for way, bar in ((f"{threads} threads", BAR), ("1 thread", None)):
        compared(f"{what}, {way}", took[way], took[peer], peer, bar=bar)
    what = f"read the columns of {ONE_TOPIC}, 1 thread"
    for library in READERS:
        if library in library_versions:
            compared(what, took[ours_to(library)], took[library], library_versions[library])
        else:
            not_run(f"{what}, against {library}", f"{PYTHON} names no interpreter that has it")


def ours_to(library: str) -> str:
    """Return the name of our turns beside a reader that isn't locked."""
    return f"1 thread, beside {library}"


def foreign(library: str, path: Path) -> dict[str, Any] | None:
    """Return what a reader that isn't locked printed; None if there is none."""
    if PYTHON not in os.environ:
        return None
    command = [os.environ[PYTHON], HERE / "foreign_reader.py", library, path, ONE_TOPIC]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "ModuleNotFoundError" in done.stderr:
        return None
    done.check_returncode()
    return json.loads(done.stdout)


if __name__ == "__main__":
    main()
