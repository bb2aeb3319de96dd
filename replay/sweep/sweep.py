"""A sweep from its plan to its rows: what is there already is not run a second time.

Runs go to :mod:`.workers`; their rows are written here, where the sweep was started, as they come
in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from undulog.capture.common.files import is_file
from undulog.capture.common.process import StopRequest
from undulog.capture.common.untrusted_text import read_toml
from undulog.capture.robot.description import load_robot, robot_names
from undulog.sim.scenario.scenario_file import scenario_text

from .plan import SweepPlan, points_of, runs_of
from .rows import Row, RowStore
from .run import (
    Job,
    RobotText,
    Setting,
    digest_of,
    options_of,
    run_job,
    run_key,
    scenario_of,
    software,
)
from .workers import LocalWorkers, processors, run_local, run_on_cluster


@dataclass(frozen=True)
class PreparedSweep:
    """The runs of a plan.

    Attributes:
        points: How many points its design has.
        digest: Of what its runs share.
        jobs: In the order of the design.
        simulated_s: Simulated time of the first run [s].
    """

    plan: SweepPlan
    points: int
    setting: Setting
    digest: str
    jobs: tuple[Job, ...]
    simulated_s: float


@dataclass(frozen=True)
class SweepCost:
    """What a sweep takes.

    Attributes:
        planned: Runs of the plan.
        there_before: Those whose rows are there.
        workers: Runs at a time.
        run_s: Processor time of the first run, measured [s]; None where all are there.
        estimated_s: Time that the rest takes [s].
        error: Why the first run failed, or empty.
        damaged: Files of rows that can't be read; their runs are to be made again.
    """

    planned: int
    there_before: int
    workers: int
    run_s: float | None
    estimated_s: float
    error: str = ""
    damaged: tuple[str, ...] = ()

    @property
    def to_run(self) -> int:
        """Runs that are not there."""
        return self.planned - self.there_before


@dataclass(frozen=True)
class SweepReport:
    """How a sweep went.

    Attributes:
        output: Address of the rows.
        planned: Runs of the plan.
        there_before: Those whose rows were there.
        run: Those that were run now, failed ones among them.
        failed: Those that failed, now or before.
        wall_s: How long it took [s].
        run_s: Time in runs, summed over the workers [s].
        missing: Those without a row that can be read, at the end.
        error: The first one of those that were run now and failed, or empty.
        damaged: Files of rows that were damaged, what was wrong and where they are now.
    """

    output: str
    planned: int
    there_before: int
    run: int
    failed: int
    wall_s: float
    run_s: float
    missing: int
    error: str = ""
    damaged: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every run of the plan has a row that can be read."""
        return not self.missing


def prepare(plan: SweepPlan, folder: Path, output: str) -> PreparedSweep:
    """Find the runs of a plan and their keys.

    Args:
        folder: Where a scenario's path starts: the plan's folder.
        output: Address of the rows.

    Raises:
        UsageError: If there is no such scenario.
        InputFileError: If a file can't be read.
        ScenarioError: If the first or the last point doesn't fit; lists all faults. So
            RobotFileError and PlanError for parameters of the robot and of the analysis. Other
            points that don't fit become failed rows.
    """
    beside = folder / plan.scenario
    scenario = scenario_text(beside if is_file(beside) else plan.scenario)
    address = output if "://" in output else str(Path(output).resolve())
    setting = Setting(
        scenario=scenario.text,
        name=scenario.source.name,
        robots=_robots(plan, scenario.text, scenario.source.parent),
        duration_s=plan.duration_s,
        kernels=plan.kernels,
        options=plan.analysis,
        software=software(),
        sessions=address if plan.sessions else None,
    )
    points, simulated_s = points_of(plan), 0.0
    for changes in (points[-1], points[0]):
        simulated_s = scenario_of(setting, changes).duration_s
        options_of(setting, changes)
    digest = digest_of(setting.facts())
    jobs = {
        key: Job(key, changes, seed)
        for changes, seed in runs_of(plan)
        for key in [run_key(digest, changes, seed)]
    }
    return PreparedSweep(plan, len(points), setting, digest, tuple(jobs.values()), simulated_s)


def cost_of(sweep: PreparedSweep, store: RowStore, workers: int) -> SweepCost:
    """Measure the first run that is to be made, and tell what all of them take.

    Args:
        workers: Runs at a time.

    Raises:
        InputFileError: If the rows that are there can't be read.
    """
    jobs = _missing(sweep, store.facts(), retry=False)
    run_s, error = None, ""
    if jobs:
        setting = replace(sweep.setting, sessions=None)
        run_job(setting, jobs[0])  # imports and compiles
        row = run_job(setting, jobs[0])
        run_s, error = float(row["run_wall"]), str(row["error"])
    planned = len(sweep.jobs)
    estimated_s = len(jobs) * (run_s or 0.0) / max(1, min(workers, len(jobs)))
    there, damaged = planned - len(jobs), tuple(store.damaged)
    return SweepCost(planned, there, workers, run_s, estimated_s, error, damaged)


def run_sweep(
    sweep: PreparedSweep,
    store: RowStore,
    *,
    workers: LocalWorkers | int | None = None,
    cluster: str | None = None,
    retry: bool = False,
    stop: StopRequest | None = None,
    on_row: Callable[[Row, int], None] = lambda _row, _there: None,
    on_damage: Callable[[str], None] = lambda _text: None,
) -> SweepReport:
    """Run what a sweep's store does not hold yet.

    Every file of rows is compared with its checksum before the first run and after the last one.
    Damaged ones are set aside, and those found before the first run have their runs made again.

    Args:
        workers: Processes of this computer, or how many; by default one a processor.
        cluster: Address of a Dask scheduler, to run there instead.
        retry: Whether runs that failed are run again.
        on_row: Called with each new row and the number of those that were there before.
        on_damage: Called with what is wrong with each damaged file, and where it is now.

    Raises:
        InputFileError: If the store can't be read.
        LogWriteError: If a row can't be written.
        SourceError: If the cluster can't be reached.
        UsageError: If a worker has other software, or another sweep writes into the store.
    """
    start, stop = time.monotonic(), stop or StopRequest()
    run, run_s, error = 0, 0.0, ""
    damaged: list[str] = []
    with store.writing():
        there = _checked(store, damaged, on_damage)
        jobs = _missing(sweep, there, retry=retry)
        store.drop(job.key for job in jobs if job.key in there)
        store.settle(sweep.digest, sweep.setting.facts())
        before = len(sweep.jobs) - len(jobs)
        keys = {job.key for job in sweep.jobs} - {job.key for job in jobs}
        failed = sum(there[key]["status"] == "failed" for key in keys)
        with ExitStack() as stack:
            if cluster is not None:
                rows = run_on_cluster(sweep.setting, jobs, cluster, stop)
            elif isinstance(workers, LocalWorkers):
                rows = run_local(sweep.setting, jobs, workers, stop)
            else:
                local = stack.enter_context(LocalWorkers(workers or processors()))
                rows = run_local(sweep.setting, jobs, local, stop)
            stack.enter_context(closing(rows))
            for row in rows:
                store.add({"setting": sweep.digest, **row})
                run += 1
                failed += row["status"] == "failed"
                error = error or row["error"]
                run_s += row.get("run_wall", 0.0)
                on_row(row, before)
        store.gather()
        there = _checked(store, damaged, on_damage)
    missing = sum(job.key not in there for job in sweep.jobs)
    return SweepReport(
        output=store.where,
        planned=len(sweep.jobs),
        there_before=before,
        run=run,
        failed=failed,
        wall_s=time.monotonic() - start,
        run_s=run_s,
        missing=missing,
        error=error,
        damaged=tuple(damaged),
    )


def _checked(
    store: RowStore, damaged: list[str], on_damage: Callable[[str], None]
) -> dict[str, Row]:
    """Return the rows that can be read; set damaged files aside and add them to a list."""
    there = store.facts()
    for text in store.set_damaged_aside():
        damaged.append(text)
        on_damage(text)
    return there


def _missing(sweep: PreparedSweep, there: Mapping[str, Row], *, retry: bool) -> list[Job]:
    def missing(job: Job) -> bool:
        row = there.get(job.key)
        if row is None or (retry and row["status"] == "failed"):
            return True
        return sweep.plan.sessions and row["status"] == "done" and not row["session"]

    return [job for job in sweep.jobs if missing(job)]


def _robots(plan: SweepPlan, scenario: str, folder: Path) -> dict[str, RobotText]:
    """Read the robots that the scenario or a parameter names; a wrong name is found later."""
    names: list[Any] = []
    with suppress(ValueError):
        names.append(read_toml(scenario).get("robot"))
    names += [
        value
        for parameter in plan.parameters
        if parameter.key == "robot"
        for value in parameter.values
    ]
    texts: dict[str, RobotText] = {}
    for name in dict.fromkeys(map(str, names)):
        shipped = name in robot_names()
        if shipped or is_file(folder / name):
            robot = load_robot(name if shipped else folder / name)
            texts[name] = RobotText(robot.toml, dict(robot.databases))
    return texts
