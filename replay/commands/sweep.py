"""Command ``sweep``."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.common.console import complain, emit, progress
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import interruptible

if TYPE_CHECKING:
    from ..sweep.sweep import PreparedSweep, SweepCost, SweepReport


def sweep(
    plan: Path,
    /,
    *,
    output: Annotated[str, Parameter(name=["--output", "-o"])],
    workers: int | None = None,
    cluster: str | None = None,
    dry_run: bool = False,
    retry_failed: bool = False,
    json: bool = False,
) -> int:
    """Run the twin over a design of parameters; every run becomes a row of results.

    A plan names a scenario, the parameters and their design (grid, random or Sobol). Rows are kept
    by a hash of everything that determines them: an interrupted sweep goes on where it stopped, an
    extended one runs only what is new. A run that fails keeps its error. Damaged files of rows are
    moved to the folder `damaged` there, and their runs made again. Exit code 1: interrupted, rows
    that can't be read, or every run failed.

    Example: `undulog sweep strength.toml -o strength --workers 2`

    Args:
        plan: The plan, `.toml`.
        output: Folder of the rows, or a URL such as `s3://bucket/strength`; what is there is kept.
        workers: Processes of this computer; one a processor by default.
        cluster: Address of a running Dask scheduler, e.g. `tcp://127.0.0.1:8786`.
        dry_run: Run nothing; print how many runs there are and what they take.
        retry_failed: Run again what failed.
        json: Print one JSON object instead of text.
    """
    if workers is not None and workers < 1:
        raise UsageError(f"--workers {workers}: give 1 or more")
    if workers is not None and cluster is not None:
        raise UsageError("--workers and --cluster: give one of them")
    from ..sweep.plan import read_plan
    from ..sweep.rows import RowStore
    from ..sweep.sweep import cost_of, prepare, run_sweep
    from ..sweep.workers import processors, workers_of

    prepared = prepare(read_plan(plan), plan.parent, output)
    if dry_run:
        at_a_time = workers_of(cluster) if cluster is not None else workers or processors()
        cost = cost_of(prepared, RowStore(output), at_a_time)
        facts = {**asdict(cost), "points": prepared.points, "to_run": cost.to_run}
        emit(facts, _cost_lines(plan, prepared, cost), as_json=json)
        return 0
    start = time.monotonic()
    with interruptible() as stop, progress(plan.stem, len(prepared.jobs)) as bar:
        done = itertools.count(1)

        def count(_row: dict[str, Any], before: int) -> None:
            now = next(done)
            bar.update(before + now, f"{now / (time.monotonic() - start):.2g} runs/s")

        report = run_sweep(
            prepared,
            RowStore(output),
            workers=workers,
            cluster=cluster,
            retry=retry_failed,
            stop=stop,
            on_row=count,
            on_damage=complain,
        )
    facts = {**asdict(report), "complete": report.complete}
    emit(facts, _report_lines(report), as_json=json)
    return 0 if report.complete and report.failed < report.planned else 1


def _report_lines(report: SweepReport) -> list[str]:
    rows = f"{report.planned - report.missing} of {report.planned} runs"
    lines = [f"{report.output}: {rows}, {report.run} of them now in {report.wall_s:.1f} s"]
    if report.failed:
        example = f", e.g. {report.error}" if report.error else ""
        lines.append(f"{report.failed} failed; the column error gives the reason{example}")
    if report.damaged:
        count = len(report.damaged)
        lines.append(f"{count} damaged file{'s' if count > 1 else ''} of rows set aside")
    if not report.complete:
        ended = report.there_before + report.run < report.planned
        why = "Interrupted" if ended else f"{report.missing} rows were damaged meanwhile"
        lines.append(f"{why}; the same command goes on.")
    return lines


def _cost_lines(plan: Path, sweep: PreparedSweep, cost: SweepCost) -> list[str]:
    seeds = f"{sweep.plan.seeds} seed{'s' if sweep.plan.seeds > 1 else ''} each"
    design = f"{sweep.points} points of a {sweep.plan.design} design, {seeds}"
    lines = [
        f"{plan}: {cost.planned} runs of {sweep.simulated_s:g} s: {design}",
        f"There already: {cost.there_before}; to run: {cost.to_run}",
    ]
    if cost.run_s is not None:
        length = timedelta(seconds=math.ceil(cost.estimated_s))
        lines.append(
            f"About {length} at {cost.workers} runs at a time, {cost.run_s:.2g} s a run as "
            "measured on the first one"
        )
    if cost.damaged:
        lines.append(f"Damaged, with runs to make again: {', '.join(cost.damaged)}")
    if cost.error:
        lines.append(f"The first one fails: {cost.error}")
    return lines
