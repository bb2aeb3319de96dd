"""A sweep from its plan to its rows: what is there already is not run a second time.

Runs go to the processes of this computer, or to a Dask cluster that runs already. The rows are
written here, where the sweep was started, as they come in: a worker or a scheduler that ends takes
only what it had begun, and that is begun anew.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from typing import Any, Self

from undulog.capture.common.console import complain
from undulog.capture.common.errors import MissingExtraError, SourceError, UndulogError
from undulog.capture.common.process import StopRequest
from undulog.capture.common.strict_table import read_toml
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
    row_of,
    run_job,
    run_key,
    scenario_of,
    software,
)


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
    """

    planned: int
    there_before: int
    workers: int
    run_s: float | None
    estimated_s: float
    error: str = ""

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
        error: The first one of those that were run now and failed, or empty.
    """

    output: str
    planned: int
    there_before: int
    run: int
    failed: int
    wall_s: float
    run_s: float
    error: str = ""

    @property
    def complete(self) -> bool:
        """Whether every run of the plan has a row."""
        return self.there_before + self.run == self.planned


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
    found = scenario_text(beside if beside.is_file() else plan.scenario)
    address = output if "://" in output else str(Path(output).resolve())
    setting = Setting(
        scenario=found.text,
        name=found.source.name,
        robots=_robots(plan, found.text, found.source.parent),
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
    return SweepCost(planned, planned - len(jobs), workers, run_s, estimated_s, error)


def run_sweep(
    sweep: PreparedSweep,
    store: RowStore,
    *,
    workers: LocalWorkers | int | None = None,
    cluster: str | None = None,
    retry: bool = False,
    stop: StopRequest | None = None,
    on_row: Callable[[Row, int], None] = lambda _row, _there: None,
) -> SweepReport:
    """Run what a sweep's store does not hold yet.

    Args:
        workers: Processes of this computer, or how many; by default one a processor.
        cluster: Address of a Dask scheduler, to run there instead.
        retry: Whether runs that failed are run again.
        on_row: Called with each new row and the number of those that were there before.

    Raises:
        InputFileError: If the store can't be read.
        LogWriteError: If a row can't be written.
        SourceError: If the cluster can't be reached.
        UsageError: If a worker has other software, or another sweep writes into the store.
    """
    start, stop = time.monotonic(), stop or StopRequest()
    run, run_s, error = 0, 0.0, ""
    with store.writing():
        there = store.facts()
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
                own = stack.enter_context(LocalWorkers(workers or processors()))
                rows = run_local(sweep.setting, jobs, own, stop)
            stack.enter_context(closing(rows))
            for row in rows:
                store.add({"setting": sweep.digest, **row})
                run += 1
                failed += row["status"] == "failed"
                error = error or row["error"]
                run_s += row.get("run_wall", 0.0)
                on_row(row, before)
        store.gather()
    wall_s = time.monotonic() - start
    return SweepReport(store.where, len(sweep.jobs), before, run, failed, wall_s, run_s, error)


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


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
    names += [value for one in plan.parameters if one.key == "robot" for value in one.values]
    found: dict[str, RobotText] = {}
    for name in map(str, names):
        shipped = name in robot_names()
        if shipped or (folder / name).is_file():
            robot = load_robot(name if shipped else folder / name)
            found[name] = RobotText(robot.toml, dict(robot.databases))
    return found


_AHEAD = 2
"""Runs that are handed out at a time, for each worker."""
_COUNT_S = 2.0
"""How often the workers of a cluster are counted [s]."""
PATIENCE_S = 300.0
"""How long a scheduler that ended is waited for [s]."""

_ATTEMPTS = 3
"""A run whose worker ends so often is a failed one."""
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def _one_thread_each() -> Generator[None]:
    """Processes that begin within have one thread each for linear algebra."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name in _THREADS:
            del os.environ[name]
        os.environ.update((name, value) for name, value in before.items() if value is not None)


def _begin_worker() -> None:
    """Leave Ctrl-C to the coordinator, and end with it, however it ends."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


class _Queue:
    """Jobs that wait, those that were begun and lost before the others."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._waiting = iter(jobs)
        self._lost: list[Job] = []
        self._attempts: Counter[str] = Counter()

    def next(self) -> Job | None:
        """Return the next job, None after the last one."""
        job = self._lost.pop() if self._lost else next(self._waiting, None)
        if job is not None:
            self._attempts[job.key] += 1
        return job

    def attempt(self, job: Job) -> int:
        """Return how often a job was begun."""
        return self._attempts[job.key]

    def put_back(self, jobs: Iterable[Job]) -> Iterator[Row]:
        """Put back jobs that were lost; yield the row of each that was lost too often."""
        for job in jobs:
            if self.attempt(job) < _ATTEMPTS:
                self._lost.append(job)
            else:
                yield failed(job, f"its worker ended {_ATTEMPTS} times")


class LocalWorkers:
    """Processes of this computer, for one sweep or several in turn; use it in a ``with`` block.

    Attributes:
        count: How many there are.
    """

    def __init__(self, count: int) -> None:
        """Begin none yet: they begin with the first runs."""
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        """Enter the block that owns the processes."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes."""
        self.end()

    def end(self) -> None:
        """End the processes; others begin with the next run."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        self._pool = None

    def submit(self, setting: Setting, job: Job) -> Future[Row]:
        """Hand out a run."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.count, get_context("spawn"), _begin_worker)
        with _one_thread_each():  # the pool starts its processes when it gets work
            return self._pool.submit(run_job, setting, job)


def run_local(
    setting: Setting, jobs: Iterable[Job], workers: LocalWorkers, stop: StopRequest
) -> Generator[Row]:
    """Run jobs in processes of this computer.

    Yields:
        Rows as they are done; none is begun any more once an end is requested.
    """
    queue = _Queue(jobs)
    lost: list[Job] | None = None
    while lost is None or lost:
        lost = []
        running: dict[Future[Row], Job] = {}
        try:
            while not lost:
                if stop.requested:
                    running = {one: job for one, job in running.items() if not one.cancel()}
                while len(running) < _AHEAD * workers.count and not stop.requested:
                    if (job := queue.next()) is None:
                        break
                    try:
                        running[workers.submit(setting, job)] = job
                    except BrokenProcessPool:  # since the sweep before
                        lost.append(job)
                        break
                if not running and not lost:
                    return
                done, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    job = running.pop(future)
                    try:
                        yield future.result()
                    except BrokenProcessPool:
                        lost.append(job)
        finally:
            if lost or running:  # they were lost, or nobody waits for what they run
                workers.end()
        lost += running.values()
        yield from queue.put_back(lost)


def failed(job: Job, why: str) -> Row:
    """Return the row of a run that gave none."""
    return {**row_of(job), "status": "failed", "error": why}


def run_on_cluster(
    setting: Setting, jobs: Iterable[Job], address: str, stop: StopRequest
) -> Generator[Row]:
    """Run jobs on a Dask cluster.

    A scheduler that ends may come back at the same address within :data:`PATIENCE_S`: what it had
    is handed out again.

    Args:
        address: Of its scheduler, e.g. ``tcp://127.0.0.1:8786``.

    Yields:
        Rows as they are done; what is not done when an end is requested is given up.

    Raises:
        MissingExtraError: If dask isn't installed.
        SourceError: If no scheduler answers there.
        UndulogError: If a worker has other software, or can't keep a session.
    """
    queue = _Queue(jobs)
    client = _connected(address, stop, patience_s=0.0)
    running: dict[Any, Job] = {}
    threads, counted = 0, -_COUNT_S
    try:
        while not stop.requested:
            if client.status != "running":
                yield from queue.put_back(running.values())
                running.clear()
                _close(client)
                complain(f"{address}: the scheduler ended; waiting {PATIENCE_S:g} s for another")
                client = _connected(address, stop, PATIENCE_S)
            if time.monotonic() - counted > _COUNT_S:
                threads, counted = _threads(client), time.monotonic()
            while len(running) < _AHEAD * max(1, threads):
                if (job := queue.next()) is None:
                    break
                name = f"{job.key}-{queue.attempt(job)}"
                running[client.submit(run_job, setting, job, key=name)] = job
            if not running:
                return
            done = [future for future in running if future.status != "pending"]
            if not done:
                time.sleep(0.02)
            for future in done:
                job = running.pop(future)
                row = _outcome(future, job)
                yield from queue.put_back([job]) if row is None else [row]
        client.cancel(list(running))
    finally:
        _close(client)


def _outcome(future: Any, job: Job) -> Row | None:
    """Return the row of a future that ended, or None if the cluster lost it."""
    try:
        if future.status == "finished":
            return future.result(timeout=10)
        if future.status != "error":
            return None
        error = future.exception(timeout=10)
    except (OSError, TimeoutError, CancelledError):
        return None  # the scheduler ended meanwhile
    if isinstance(error, UndulogError):
        raise error
    return failed(job, f"its worker ended: {type(error).__name__}: {error}")


def workers_of(address: str) -> int:
    """Return how many runs a cluster works on at a time.

    Raises:
        MissingExtraError: If dask isn't installed.
        SourceError: If no scheduler answers there.
    """
    client = _connected(address, StopRequest(), patience_s=0.0)
    try:
        return _threads(client)
    finally:
        _close(client)


def _threads(client: Any) -> int:
    workers = client.scheduler_info(n_workers=-1)["workers"]
    return sum(worker["nthreads"] for worker in workers.values())


def _close(client: Any) -> None:
    with suppress(OSError, TimeoutError, CancelledError):  # the scheduler may be gone
        client.close(timeout=2)


def _connected(address: str, stop: StopRequest, patience_s: float) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError("sweep --cluster", "cluster", "dask") from error
    for name in ("distributed", "distributed.client"):  # a lost scheduler is reported once, here
        logging.getLogger(name).setLevel(logging.CRITICAL)
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return Client(address, timeout=5, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            if time.monotonic() > deadline or stop.requested:
                raise SourceError(address, f"no Dask scheduler answers: {error}") from error
