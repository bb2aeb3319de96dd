"""A sweep on two processes against one, and on a Dask cluster of two workers against one.

Runs: a chain of five yaw joints on the ground, 2 s each, a random design over the servos' strength.
A baseline is a tenth of the runs, on one local process or on one Dask worker. Overhead is the part
of the workers' time, wall clock times workers, that was not spent in runs, without the start of the
workers. The scheduler and its worker processes run on loopback; their rows are those of the local
processes, bit for bit.

Run: python bench/sweep.py [--runs 2000]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from measuring import arguments
from records import verdict

from undulog.replay.sweep.plan import read_plan
from undulog.replay.sweep.rows import Row, RowStore
from undulog.replay.sweep.sweep import prepare, run_sweep

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.dask_cluster import free_port, scheduler, workers
from support.sweep_plans import comparable, write_plan

PLAN = """scenario = "wave.toml"
design = "random"
points = {points}
[parameters."servo.stall_torque"]
low = 0.1
high = 0.4
"""


def measure(
    folder: Path, points: int, processes: int, cluster: str | None = None
) -> tuple[float, float]:
    """Return runs a second and the share of overhead, from the first row on."""
    plan = folder / "plan.toml"
    plan.write_text(PLAN.format(points=points))
    output = _rows(folder, processes, cluster)
    ends: list[float] = []
    spent: list[float] = []

    def note(row: Row, _before: int) -> None:
        ends.append(time.perf_counter())
        spent.append(row["run_wall"])

    report = run_sweep(
        prepare(read_plan(plan), folder, output),
        RowStore(output),
        workers=processes,
        cluster=cluster,
        on_row=note,
    )
    assert (report.run, report.failed) == (points, 0), report
    first = 2 * processes  # the workers' start, imports included
    wall = ends[-1] - ends[first - 1]
    return (points - first) / wall, 1 - sum(spent[first:]) / (processes * wall)


def _rows(folder: Path, processes: int, cluster: str | None) -> str:
    return str(folder / f"{'rows' if cluster is None else 'cluster'}{processes}")


def main() -> None:
    """Print the table."""
    runs: int = arguments(__doc__, runs=2000).parse_args().runs
    few = max(20, runs // 10)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_plan(folder, joints=5)  # its robot and scenario serve here
        single, _ = measure(folder, few, 1)
        two, overhead = measure(folder, runs, 2)
        port = free_port()
        address = f"tcp://127.0.0.1:{port}"
        with scheduler(port):
            with workers(port, folder / "dask1", 1):
                dask_one, _ = measure(folder, few, 1, address)
            with workers(port, folder / "dask2", 2):
                dask_two, dask_overhead = measure(folder, runs, 2, address)
        local = comparable(RowStore(_rows(folder, 2, None)).rows())
        same = comparable(RowStore(_rows(folder, 2, address)).rows()) == local
    print(f"1 process:      {single:.2f} runs/s ({few} runs)")
    print(f"2 processes:    {two:.2f} runs/s ({runs} runs), {two / single:.2f} times one process")
    print(f"overhead:       {100 * overhead:.1f} % of the workers' time")
    print(f"1 Dask worker:  {dask_one:.2f} runs/s, {dask_one / single:.2f} times one process")
    print(
        f"2 Dask workers: {dask_two:.2f} runs/s, {dask_two / dask_one:.2f} times one Dask worker, "
        f"{dask_two / single:.2f} times one process"
    )
    print(f"overhead:       {100 * dask_overhead:.1f} % of the workers' time")
    verdict("sweep, 2 workers, 5 joints: runs/s to one worker", two / single, None, "times")
    verdict("sweep, 2 workers: overhead", 100 * overhead, None, "% of the workers' time")
    what = "the same on a Dask cluster of 2: runs/s to one"
    verdict(f"{what} local process", dask_two / single, None, "times")
    verdict(f"{what} Dask worker", dask_two / dask_one, None, "times")
    verdict("sweep, rows of both equal", float(same), 1, "", most=False)
    print(f"same rows: {'yes' if same else 'NO'}")


if __name__ == "__main__":
    main()
