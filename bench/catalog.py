"""The catalogue: facts of many sessions, a scan with nothing new, queries, many writers.

``python bench/catalog.py [SESSIONS] [ROWS]``: writes SESSIONS (10,000) small sessions (5 joints,
4 s), scans them, scans again, and reads some of them whole for comparison; then queries ROWS
(1,000,000) synthetic rows beside pandas over the same rows as JSON lines.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from mcap.reader import make_reader
from measuring import arguments, in_turn, memory, timed, took
from records import compared, verdict, versions

from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.rows import table_of
from undulog.analysis.catalog.sources import FOLDER
from undulog.capture import Session, SessionWriter
from undulog.capture.common.object_store import ObjectStore

EPOCH_NS = 1_735_689_600_000_000_000
NAMES = tuple(f"joint{k:02d}" for k in range(1, 6))
COMPARED = 200
FACTS, AGAIN, QUERY, MEMORY = 4.0, 1.0, 0.1, 1.0
"""The bars, ratios to the peers."""
WRITERS = 16
WHERE = "robot = 'snake5' and lag_sd > 0.09"


def write(folder: Path, count: int) -> None:
    """Write distinct sessions, 100 in a folder."""
    times_s = np.arange(0.0, 4.0, 0.02)
    for number in range(count):
        place = folder / f"{number // 100:04d}"
        place.mkdir(exist_ok=True)
        path = place / f"run{number:05d}.mcap"
        epoch_ns = EPOCH_NS + number * 60_000_000_000
        facts = {"robot": "snake5", "operator": f"operator{number % 7}"}
        with SessionWriter(
            path, session_id=f"session{number:05d}", epoch_ns=epoch_ns, metadata=facts
        ) as writer:
            commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
            states = writer.joint_state("/joint_states", NAMES, unit="rad")
            phase = 2 * np.pi * times_s[:, None] + number + np.arange(len(NAMES))
            for t_s, command, state in zip(
                times_s, 0.4 * np.sin(phase), 0.36 * np.sin(phase - 0.1), strict=True
            ):
                t_ns = epoch_ns + round(t_s * 1e9)
                commands.write(t_ns, command)
                states.write(t_ns, state)
            writer.set_verdict("good", [])


def read_whole(paths: list[Path]) -> None:
    """Read the columns of sessions, one by one."""
    for path in paths:
        with Session.open(path) as session:
            session.joints("/joint_states")


def read_summaries(paths: list[Path]) -> None:
    """Read summaries and metadata by the MCAP library."""
    for path in paths:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            reader.get_summary()
            list(reader.iter_metadata())


def synthetic(folder: Path, count: int) -> Path:
    """Write rows as a catalogue and as JSON lines."""
    rng = np.random.default_rng(1)
    store = ObjectStore(str(folder))
    store.make_folders(f"{FOLDER}/sessions", f"{FOLDER}/analyses")
    lines = folder / "rows.jsonl"
    step = 100_000
    with lines.open("w") as stream:
        for start in range(0, count, step):
            numbers = range(start, min(start + step, count))
            lag_sd = rng.uniform(0.0, 0.1, len(numbers)).tolist()
            scanned = {"scanned_ns": 1, "removed": False}
            sessions = [
                {"path": f"lab/{k}.mcap", "head": f"lab/{k}.mcap", "session_id": f"s{k}",
                 "robot": f"snake{5 + k % 3}", "part": 1, "start_ns": EPOCH_NS + k,
                 "duration_s": 4.0, "verdict": "good", **scanned}
                for k in numbers
            ]  # fmt: skip
            analyses = [
                {"source": f"lab/{k}.json", "session_id": f"s{k}", "lag_sd": value,
                 "answer": "unlike", **scanned}
                for k, value in zip(numbers, lag_sd, strict=True)
            ]  # fmt: skip
            for kind, rows in (("sessions", sessions), ("analyses", analyses)):
                store.write_table(f"{FOLDER}/{kind}/rows-{start}", table_of(kind, rows))
            for session, analysis in zip(sessions, analyses, strict=True):
                stream.write(json.dumps({**session, **analysis}) + "\n")
    return lines


def query(folder: str) -> tuple[float, int, float]:
    """Time [s], rows and peak memory [MB] of a query in a process of its own."""
    Catalog(folder).sql("select 1")  # imports
    catalog = Catalog(folder)  # which compares its files with their checksums anew
    text = f"select path, robot, start_ns, lag_sd from catalog where {WHERE}"
    used, rows = timed(partial(catalog.sql, text))
    return used.wall_s, len(rows), memory("VmHWM") / 1e6


def peer(lines: str) -> tuple[float, int, float]:
    """The same by pandas over JSON."""
    start = time.perf_counter()
    frame = pd.read_json(lines, lines=True)
    rows = frame.query("robot == 'snake5' and lag_sd > 0.09")
    return time.perf_counter() - start, len(rows), memory("VmHWM") / 1e6


def add(folder: str, writer: int) -> int:
    """Scan and add rows, as one of many writers."""
    Catalog(folder).scan()
    return writer


def alone(function: object, place: str) -> tuple[float, int, float]:
    """Call a function in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, place).result()  # type: ignore[arg-type]


def main() -> None:
    """Run everything and judge it."""
    parser = arguments(__doc__, runs=3)
    parser.add_argument("sessions", type=int, nargs="?", default=10_000)
    parser.add_argument("rows", type=int, nargs="?", default=1_000_000)
    given = parser.parse_args()
    good: list[bool] = []
    with tempfile.TemporaryDirectory(prefix="undulog-bench-") as name:
        folder = Path(name)
        write(folder, given.sessions)
        (used, first), (rescan, again) = (timed(lambda: Catalog(name).scan()) for _ in range(2))
        paths = sorted(folder.rglob("*.mcap"))
        summaries = took(partial(read_summaries, paths)).processor_s
        whole = took(partial(read_whole, paths[:COMPARED])).wall_s
        scale = len(paths) / min(len(paths), COMPARED)
        print(f"{given.sessions} sessions: facts {first.wall_s:.1f} s, again {again.wall_s:.2f} s")
        size, peer_name = f"{given.sessions} sessions", f"{versions('mcap')}, summary and metadata"
        good += [
            verdict("catalog: sessions read in the first scan", first.read, given.sessions, "",
                    most=False),
            verdict("catalog: sessions read with nothing new", again.read, 0, ""),
            compared(f"catalog: facts of {size}", [used.processor_s], [summaries], peer_name,
                     bar=FACTS),
            compared(f"catalog: scan of {size}, nothing new", [rescan.processor_s], [summaries],
                     peer_name, bar=AGAIN),
        ]  # fmt: skip
        compared(
            f"catalog: facts of {size}", [used.processor_s], [whole],
            f"reading the columns of each by undulog (scaled from {COMPARED})", scale=scale,
        )  # fmt: skip
        with ProcessPoolExecutor(WRITERS, get_context("spawn")) as pool:
            (folder / FOLDER).rename(folder / "away")
            done = list(pool.map(add, [name] * WRITERS, range(WRITERS)))
        counts = Catalog(name).sql(
            "select count(*) as n, count(distinct path) as paths from catalog"
        )
        complete = counts.n[0] == counts.paths[0] == given.sessions and len(done) == WRITERS
        what = f"catalog: {WRITERS} writers at once, each session once"
        good.append(verdict(what, float(complete), 1, "", most=False))
    with tempfile.TemporaryDirectory(prefix="undulog-bench-") as name:
        lines = synthetic(Path(name), given.rows)
        Catalog(name).scan()  # puts the files together
        turns = in_turn(given.runs, partial(alone, query, name), partial(alone, peer, str(lines)))
        assert all(ours[1] == theirs[1] for ours, theirs in zip(*turns, strict=True)), (
            "other rows were found"
        )
        pandas = f"{versions('pandas')} over JSON lines"
        what = f"catalog: query of {given.rows} rows"
        for k, bar, unit, more in ((0, QUERY, "s", ""), (2, MEMORY, "MB", ", peak memory")):
            costs = [[figures[k] for figures in side] for side in turns]
            good.append(compared(what + more, *costs, pandas, bar=bar, unit=unit))
    sys.exit(not all(good))


if __name__ == "__main__":
    main()
