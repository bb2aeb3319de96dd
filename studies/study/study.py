"""Run the study and write its page.

``make study`` is the short form: 5 and 9 yaw joints, a few minutes, page and rows under
``out/study/quick``. ``make study LONG=1`` is the long form; it goes on where it stopped, also from
the rows in ``studies/study/rows/long.parquet`` where the code that determines them is the same,
gathers its own there and writes ``docs/study.md`` with its figures.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from study.design import PLANS, stages
from study.rows import gather, scatter
from undulog.capture.common.process import StopRequest, interruptible
from undulog.replay.sweep.rows import RowStore
from undulog.replay.sweep.run import software
from undulog.replay.sweep.sweep import prepare, run_sweep
from undulog.replay.sweep.workers import LocalWorkers

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
OUT = ROOT / "out" / "study"


def run(folder: Path, stop: StopRequest, *, quick: bool, workers: int) -> bool:
    """Run what the folder lacks; return whether all is there."""
    start = time.monotonic()
    with LocalWorkers(workers) as processes:
        for stage in stages(quick=quick):
            output = str(folder / stage.name)
            sweep = prepare(stage.plan, PLANS, output)
            report = run_sweep(sweep, RowStore(output), workers=processes, stop=stop)
            print(
                f"{time.monotonic() - start:6.0f} s  {stage.name}: "
                f"{report.there_before + report.run} of {report.planned} runs, "
                f"{report.failed} failed",
                flush=True,
            )
            if not report.complete:
                print("Interrupted; the same command goes on.")
                return False
    return True


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the short form")
    parser.add_argument("-o", "--out", type=Path, help="folder of all rows")
    parser.add_argument("--workers", type=int, default=2, help="runs at a time")
    parser.add_argument("--no-runs", action="store_true", help="page from the rows that are there")
    parser.add_argument("--no-page", action="store_true", help="only run")
    chosen = parser.parse_args()
    folder: Path = chosen.out or OUT / ("quick" if chosen.quick else "long")
    rows = folder / "rows.parquet" if chosen.quick else Path(__file__).parent / "rows/long.parquet"
    if not chosen.quick and not chosen.no_runs:
        scatter(rows, folder, software()["source"])
    with interruptible() as stop:
        if not chosen.no_runs and not run(folder, stop, quick=chosen.quick, workers=chosen.workers):
            return 1
    if chosen.no_page:
        return 0
    from study.page import write_page

    if not chosen.no_runs or folder.exists():
        gather(folder, rows)
    page = folder / "study.md" if chosen.quick else DOCS / "study.md"
    write_page(rows, page, quick=chosen.quick)
    print(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
