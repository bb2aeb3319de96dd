"""Damaged results: rows of sweeps and catalogues, as disks, copies, kills and people leave them.

What is there afterwards is judged by pyarrow: exit code 0 means that every row of the
plan is there, once, and equal to that of an undisturbed sweep. Nothing is deleted: the bytes of a
damaged file lie in the folder of damaged ones.
"""

import json
import os
import random
import shutil

import pyarrow as pa
import pyarrow.parquet as pq

from support.damage import damaged_bytes
from support.sweep_plans import comparable, write_plan
from support.written_sessions import write_session
from undulog.replay.sweep.run import software

from .base import write_files
from .case import Result, front_door, judge, run_forked
from .mutate import mutate_bytes, mutate_text

STRENGTHS = (0.2, 0.25, 0.3, 0.35)
SWEEP = ["sweep", "plan.toml", "-o", "out"]
CATALOG = ["catalog", "lab", "--json"]
KINDS = ("sessions", "analyses", "joints", "sources")
COLUMNS = ["path", "session_id", "messages", "status"]


# -- what is damaged -------------------------------------------------------------------------------


def sweep_base(stage):
    """Make a sweep once: five rows of it in two files, one pending."""
    software()  # kept by the processes that are forked from this one
    folder = stage.folder / "bases" / "sweep"
    if not folder.exists():
        part = folder.with_name(f"sweep{os.getpid()}")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        write_plan(part, STRENGTHS, name="plan.toml")
        outcome = run_forked(from_stored(SWEEP), part)
        if outcome.code:
            raise RuntimeError(outcome.errors)
        _spread(part / "out")
        _renamed(part, folder)
    return folder


def catalog_base(stage):
    """Make a catalogue once: of two scans, with a result and a session that was removed."""
    folder = stage.folder / "bases" / "lab"
    if not folder.exists():
        part = folder.with_name(f"lab{os.getpid()}")
        shutil.rmtree(part, ignore_errors=True)
        (part / "lab").mkdir(parents=True)
        files = next(base.files for base in stage.bases if base.name == "gait.mcap")
        write_session(part / "lab" / "plain.mcap", count=20)
        write_session(part / "lab" / "gone.mcap", count=20)
        write_files(part / "lab", files)
        path = part / "lab" / "gait.mcap"
        path.with_suffix(".json").write_bytes(stage.result_of(path))
        for _ in range(2):
            outcome = run_forked(front_door(CATALOG), part)
            if outcome.code:
                raise RuntimeError(outcome.errors)
            (part / "lab" / "gone.mcap").unlink(missing_ok=True)
        (part / "rows.json").write_bytes(outcome.out)
        _renamed(part, folder)
    return folder


def _renamed(part, folder):
    try:
        part.rename(folder)
    except OSError:  # another worker was faster
        shutil.rmtree(part)


def _spread(output):
    """Put the rows of a sweep into two Parquet files and a pending one."""
    from undulog.replay.sweep.rows import RowStore

    rows = list(RowStore(str(output)).rows())
    (output.parent / "rows.json").write_text(json.dumps(rows))
    shutil.rmtree(output / "rows")
    store = RowStore(str(output))
    with store.writing():
        for row in rows[:2]:
            store.add(row)
        store.gather()
        store.add(rows[2])
        store.gather()
        store.add(rows[3])


def from_stored(words, stored=None):
    """Return a function that runs a sweep's command, its runs in the process itself.

    A process for the runs would import for seconds in each case; what is attacked is the store. So
    runs that were made once are not made again: their rows are taken from the file ``stored``.
    """

    def work():
        from undulog.replay.sweep import sweep
        from undulog.replay.sweep.run import run_job

        rows = {row["key"]: row for row in json.loads(stored.read_text())} if stored else {}

        def run_local(setting, jobs, *_):
            return (rows.get(job.key) or run_job(setting, job) for job in jobs)

        sweep.run_local = run_local
        front_door(words)()

    return work


# -- damages ---------------------------------------------------------------------------------------


def _changed(path, rng):
    data = path.read_bytes()
    kind = rng.randrange(4)
    if kind == 0 and len(data):
        changed = bytearray(data)
        for _ in range(rng.choice([1, 1, 40])):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        changed = damaged_bytes(rng, data, rng.choice([1, 40, 4096]))
        changed = data[: len(data) // 2] if changed is None else changed
    elif kind == 2 and path.suffix == ".json":
        changed = mutate_text(data, rng)
    else:
        changed = mutate_bytes(data, rng)
    path.write_bytes(changed)


def _cut(path, rng):
    path.write_bytes(path.read_bytes()[: rng.choice([0, 0, 1, 4, 100])])


def _as_folder(path, rng):
    path.unlink()
    path.mkdir()
    if rng.random() < 0.5:
        (path / "file").write_text("of another program")


def _foreign(path, rng):
    if path.suffix == ".json":
        path.write_text(
            rng.choice(["[]", "null", '{"key": 1}', "1e999", "[" * 100_000, "9" * 9999])
        )
        return
    table = rng.choice(
        [
            pa.table({"x": [1, 2]}),
            pa.table({"key": [1], "status": [2], "session": [3]}),
            pa.table({"key": ["a", None], "status": ["done"] * 2, "session": [""] * 2}),
            pa.table({"source": [b"\xff"], "scanned_ns": ["x"], "removed": [None]}),
        ]
    )
    pq.write_table(table, path)


def _link(path, rng):
    path.unlink()
    path.symlink_to(rng.choice(["nowhere", path.name]))


DAMAGES = [_changed, _changed, _changed, _cut, _as_folder, _foreign, _link]


def _of_another_plan(output, rng):
    """Add whole rows that are none of this plan's."""
    from undulog.replay.sweep.rows import RowStore

    store = RowStore(str(output))
    with store.writing():
        for _ in range(rng.randrange(1, 4)):
            key = f"{rng.getrandbits(128):032x}"
            store.add({"key": key, "status": "done", "session": "", "error": "", "other": "x"})
        if rng.random() < 0.5:
            store.gather()


def _without_checksums(folder):
    """Rename files as earlier versions did."""
    for path in sorted(folder.rglob("*-*")):
        stem, _, checksum = path.stem.rpartition("-")
        if path.is_file() and len(checksum) == 32:
            path.rename(path.with_name(stem + path.suffix))


# -- the cases -------------------------------------------------------------------------------------


def run(seed, stage):
    """Damage results, then run the command that made them, once or twice at a time."""
    rng = random.Random(seed)
    with stage.fresh() as folder:
        return (_run_sweep if rng.random() < 0.6 else _run_catalog)(rng, folder, stage)


def _damage(rng, paths):
    """Damage one or two of some files; return the bytes that are to be kept, and a text."""
    kept, done = [], []
    for path in rng.sample(paths, min(len(paths), rng.choice([1, 1, 2]))):
        before, damage = path.read_bytes(), rng.choice(DAMAGES)
        damage(path, rng)
        done.append(f"{damage.__name__} {path.parent.name}/{path.suffix}")
        if path.is_file() and path.read_bytes() != before:
            kept.append(path.read_bytes())
    return kept, ", ".join(done)


def _run_sweep(rng, folder, stage):
    shutil.copytree(sweep_base(stage), folder, dirs_exist_ok=True)
    expected = comparable(_rows_by_pyarrow(sweep_base(stage) / "out"))
    early = rng.random() < 0.25
    if early:
        _without_checksums(folder / "out")
    paths = [p for name in ("rows", "pending") for p in sorted((folder / "out" / name).iterdir())]
    kept, text = _damage(rng, paths)
    if rng.random() < 0.15:
        text += ", rows of another plan"
        _of_another_plan(folder / "out", rng)
    result = Result(f"{' '.join(SWEEP)}: {text}{', of an earlier version' if early else ''}")
    work = from_stored(SWEEP, folder / "rows.json")
    for outcome in _once_or_twice(work, folder, result, rng):
        if outcome.code == 2 and b"another sweep is writing" in outcome.err:
            continue
        if outcome.code:
            result.failures.append(f"exit code: {outcome.code}: {outcome.errors}")
            continue
        rows = comparable(_rows_by_pyarrow(folder / "out"))
        there = {key: row for key, row in rows.items() if key in expected}
        if there.keys() != expected.keys():
            result.failures.append("rows: exit code 0 without all rows")
        elif not early and there != expected:
            result.failures.append("rows: exit code 0 with other values")
    left = {path.read_bytes() for path in (folder / "out").rglob("*") if path.is_file()}
    if not early and any(data not in left for data in kept):
        result.failures.append("deleted: a damaged file is gone")
    return result


def _rows_by_pyarrow(output):
    """Return the rows in Parquet files and pending ones."""
    rows = [json.loads(path.read_text()) for path in (output / "pending").iterdir()]
    for path in sorted((output / "rows").iterdir()):
        rows += pq.read_table(path).to_pylist()
    if len({row["key"] for row in rows}) < len(rows):
        raise ValueError("a row is there twice")
    return rows


def _run_catalog(rng, folder, stage):
    base = catalog_base(stage)
    shutil.copytree(base, folder, dirs_exist_ok=True)
    catalogue = folder / "lab" / ".undulog-catalog"
    early = rng.random() < 0.25
    if early:
        _without_checksums(catalogue)
    kept, text = _damage(rng, [p for kind in KINDS for p in sorted((catalogue / kind).iterdir())])
    result = Result(f"{' '.join(CATALOG)}: {text}{', of an earlier version' if early else ''}")
    expected = _found(json.loads((base / "rows.json").read_text()))
    for outcome in _once_or_twice(front_door(CATALOG), folder, result, rng):
        if outcome.code:
            result.failures.append(f"exit code: {outcome.code}: {outcome.errors}")
        elif not early and _found(json.loads(outcome.out)) != expected:
            result.failures.append(f"rows: {_found(json.loads(outcome.out))}")
    left = {path.read_bytes() for path in catalogue.rglob("*") if path.is_file()}
    if not early and any(data not in left for data in kept):
        result.failures.append("deleted: a damaged file is gone")
    return result


def _found(report):
    return [[row[name] for name in COLUMNS] for row in report["rows"]]


def _once_or_twice(work, folder, result, rng):
    """Run a command, in one case of five twice at a time; judge and return the outcomes."""
    other = []

    def beside(_process):
        second = folder.parent / "second"
        second.symlink_to(folder)
        other.append(run_forked(work, second))

    twice = rng.random() < 0.2
    outcomes = [run_forked(work, folder, meanwhile=beside if twice else None), *other]
    for outcome in outcomes:
        result.failures += judge(outcome)
        result.measure(outcome)
    if twice:
        result.case += ", twice at a time"
    return outcomes
