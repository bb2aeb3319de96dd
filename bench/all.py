"""All benches against their peers, collected on one page: docs/reference/benchmarks.md.

Each bench runs in a process of its own; one that fails is a row of the page, and the next one
follows. What is measured replaces the rows of the same bench in docs/reference/benchmarks.json,
and the page is written anew after each bench.

Run: python bench/all.py [--quick] [--only NAME]... [--page-only]
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks_page import page_of
from measuring import HERE, arguments
from records import RECORDS, Record, versions

ROOT = HERE.parent
DATA = ROOT / "docs/reference/benchmarks.json"
PAGE = DATA.with_suffix(".md")
LIMIT_S = 3 * 3600


class Bench(NamedTuple):
    """A script of this folder.

    Attributes:
        script: Its name without suffix.
        full: Its arguments.
        quick: Its arguments for a run of at most a minute or two.
    """

    script: str
    full: str = ""
    quick: str = ""


TARGET = "--seeds 100-101 --follow-limit 60 --walk-limit 5 -o out/target_quick.json"
BENCHES = {
    "starting": Bench("starting", "", "--runs 2"),
    "reading": Bench("read_jointstate", "", "--minutes 0.5"),
    "one-hour": Bench("one_hour", "", "--minutes 1"),
    "limits": Bench("limits", "", "--runs 1 joints channels"),
    "bag-import": Bench("bag_import", "", "--messages 8000"),
    "table-import": Bench("table_import", "", "--runs 3"),
    "data-set": Bench("data_set", "", "--episodes 500 --runs 2"),
    "durable": Bench("durable", "", "--messages 10000"),
    "sources": Bench("sources", "", "--frames 4000"),
    "serial": Bench("serial_listen", "", "--frames 4000"),
    "recording": Bench("record_buses", "", "8 --contended 0"),
    "contention": Bench("contention", "", "3 --runs 1 --only unix"),
    "small-computer": Bench("small_computer", "", "--seconds 20"),
    "live-feed": Bench("live_view", "", "--seconds 2"),
    "live-lag": Bench("live_lag", "", ""),
    "analysing": Bench("analyse_hour", "", "--minutes 2"),
    "analysing-adaptive": Bench("analyse_hour", "--adaptive", "--minutes 2 --adaptive"),
    "catalog": Bench("catalog", "", "500 50000"),
    "twin": Bench("twin_step", "", "--seconds 0.2 --runs 3"),
    "batch": Bench("batch_twin", "", "--seconds 0.5 --rounds 2"),
    "batch-gpu": Bench("batch_gpu", "", "--worlds 1024"),
    "sweep": Bench("sweep", "", "--runs 100"),
    "fleet": Bench("fleet", "", "--seeds 1"),
    "target-following": Bench("target_following", "", TARGET),
    "converting": Bench("replay_convert", "--minutes 5", "--minutes 1 --runs 2 --pairs 2 --rows 5"),
    "merging": Bench("replay_merge", "", "1"),
    "first-picture": Bench("first_picture", "", "1"),
}  # fmt: skip

PEERS = (
    "mcap", "mcap-ros2-support", "rosbags", "pandas", "pyarrow", "python-can", "dynamixel-sdk",
    "mujoco", "pybullet", "rerun-sdk", "numpy", "scipy", "numba", "numba-cuda",
)  # fmt: skip


def run_bench(name: str, *, quick: bool) -> dict[str, Any]:
    """Run one bench; return its rows and the conditions."""
    bench = BENCHES[name]
    words = [f"bench/{bench.script}.py", *(bench.quick if quick else bench.full).split()]
    print(f"\n{name}: python {' '.join(words)}", flush=True)
    begun, clock = datetime.now(UTC), time.monotonic()
    with tempfile.NamedTemporaryFile(prefix="undulog-bench-", suffix=".jsonl") as file:
        try:
            code = subprocess.run(
                [sys.executable, *words],
                cwd=ROOT,
                env={"OPENBLAS_NUM_THREADS": "1"} | os.environ | {RECORDS: file.name},
                timeout=LIMIT_S,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            code = -1
        rows = [json.loads(line) for line in Path(file.name).read_text().splitlines()]
    judged = [row["met"] for row in rows if row["met"] is not None]
    if code and all(judged):  # it did not fail by a bar
        why = f"ended with exit code {code}" if code > 0 else f"not ended after {LIMIT_S} s"
        rows.append(asdict(Record(what="the bench itself", met=False, note=why)))
    elif not rows:
        rows.append(asdict(Record(what="the bench itself", note="no figure with a peer or a bar")))
    return {
        "command": f"python {' '.join(words)}",
        "quick": quick,
        "date": begun.isoformat(timespec="minutes"),
        "took_s": round(time.monotonic() - clock, 1),
        "load": round(os.getloadavg()[0], 1),
        "machine": machine(),
        "versions": ", ".join(
            versions(package) for package in ("undulog", *PEERS) if installed(package)
        ),
        "exit": code,
        "rows": rows,
    }


def missing(data: dict[str, Any]) -> list[str]:
    """Return the names of the benches without figures."""
    return [name for name in BENCHES if name not in data]


def installed(distribution: str) -> bool:
    """Return whether a package is installed."""
    return any(distributions(name=distribution))


def machine() -> str:
    """Return processor, cores, GPUs, memory, kernel and Python."""
    facts = Path("/proc/cpuinfo").read_text().splitlines()
    model = next(line.partition(":")[2].strip() for line in facts if line.startswith("model name"))
    gpus = [
        line.partition(":")[2].strip()
        for information in Path("/proc/driver/nvidia/gpus").glob("*/information")
        for line in information.read_text().splitlines()
        if line.startswith("Model:")
    ]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    system = f"Linux {platform.release()}", f"Python {platform.python_version()}"
    return ", ".join((model, f"{os.cpu_count()} cores", f"{memory:.0f} GiB", *gpus, *system))


def main() -> int:
    """Run the benches; return 1 if one failed."""
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="short runs, for a first impression")
    parser.add_argument("--only", action="append", choices=BENCHES, metavar="NAME", default=[])
    parser.add_argument("--page-only", action="store_true", help="write the page from the JSON")
    options = parser.parse_args()
    data: dict[str, Any] = json.loads(DATA.read_text()) if DATA.exists() else {}
    failed = False
    for name in [] if options.page_only else options.only or BENCHES:
        data[name] = run_bench(name, quick=options.quick)
        failed |= any(row["met"] is False for row in data[name]["rows"])
        ordered = {name: data[name] for name in BENCHES if name in data}
        partial = DATA.with_suffix(".partial")
        partial.write_text(json.dumps(ordered, indent=1) + "\n")
        partial.replace(DATA)
        PAGE.write_text(page_of(ordered, missing(ordered)))
    if options.page_only:
        PAGE.write_text(page_of(data, missing(data)))
    print(f"\n{PAGE.relative_to(ROOT)} and {DATA.relative_to(ROOT)} are written")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
