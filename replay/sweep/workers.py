"""Workers of a sweep: processes of this computer, or a Dask cluster that runs already.

A worker or a scheduler that ends takes only what it had begun, and that is begun anew.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import partial
from typing import Any, Self

from undulog.capture.common.console import complain
from undulog.capture.common.errors import MissingExtraError, NoAnswerError, SourceError
from undulog.capture.common.process import StopRequest
from undulog.capture.common.waits import Standstill, attended

from .processes import RunProcesses, request_of, row_in, run_beside
from .rows import Row
from .run import Job, Setting, row_of

_AHEAD = 2
"""Runs that are handed out at a time, for each worker."""
_COUNT_S = 2.0
"""How often the workers of a cluster are counted [s]."""
PATIENCE_S = 300.0
"""How long a scheduler that ended or doesn't answer, or a first worker, is waited for [s]."""

_CONNECT_S = 60.0
"""How long a client may take to start [s]: Dask's own limit of 5 s is that of its connection."""
_CANCEL_S = 10.0
"""How long a scheduler may take to cancel runs, when an end is requested [s]."""
_ATTEMPTS = 3
"""A run whose worker ends so often is a failed one."""


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


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
        self._processes = RunProcesses()
        self._threads = ThreadPoolExecutor(count)

    def __enter__(self) -> Self:
        """Enter the block that owns the processes."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes."""
        self.end()

    def end(self) -> None:
        """End the processes; others begin with the next run."""
        self._threads.shutdown(cancel_futures=True)
        self._processes.end()
        self._threads = ThreadPoolExecutor(self.count)

    def submit(self, setting: Setting, job: Job) -> Future[bytes]:
        """Hand out a run."""
        return self._threads.submit(self._processes.run, request_of(setting, job))


def run_local(
    setting: Setting, jobs: Iterable[Job], workers: LocalWorkers, stop: StopRequest
) -> Generator[Row]:
    """Run jobs in processes of this computer.

    Yields:
        Rows as they are done; none is begun any more once an end is requested.
    """
    queue = _Queue(jobs)
    running: dict[Future[bytes], Job] = {}
    try:
        while True:
            if stop.requested:
                running = {future: job for future, job in running.items() if not future.cancel()}
            while len(running) < _AHEAD * workers.count and not stop.requested:
                if (job := queue.next()) is None:
                    break
                running[workers.submit(setting, job)] = job
            if not running:
                return
            done, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in done:
                job = running.pop(future)
                try:
                    answer = future.result()
                except ChildProcessError:
                    yield from queue.put_back([job])
                else:
                    yield row_in(answer)
    finally:
        if running:  # nobody waits for them
            workers.end()


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
        NoAnswerError: If the scheduler stops to answer, or no worker comes, within the limit.
        UndulogError: If a worker has other software, or can't keep a session.
    """
    queue = _Queue(jobs)
    client = _connected(address, stop, patience_s=0.0)
    running: dict[Any, Job] = {}
    threads, counted = 0, -_COUNT_S
    without = Standstill(PATIENCE_S)
    try:
        while not stop.requested:
            if client.status != "running":
                yield from queue.put_back(running.values())
                running.clear()
                _close(client)
                complain(f"{address}: the scheduler ended; waiting {PATIENCE_S:g} s for another")
                client = _connected(address, stop, PATIENCE_S)
            if time.monotonic() - counted > _COUNT_S:
                threads, counted = _threads(client, address, stop), time.monotonic()
            if without.reached(time.monotonic() if threads else None):
                advice = "start one by 'dask worker'; rows that are done are kept"
                raise NoAnswerError(f"{address}: a worker of the cluster", PATIENCE_S, advice)
            while len(running) < _AHEAD * max(1, threads):
                if (job := queue.next()) is None:
                    break
                name = f"{job.key}-{queue.attempt(job)}"
                running[client.submit(run_beside, request_of(setting, job), key=name)] = job
            if not running:
                return
            done = [future for future in running if future.status != "pending"]
            if not done:
                time.sleep(0.02)
            for future in done:
                job = running.pop(future)
                row = _outcome(future, job)
                yield from queue.put_back([job]) if row is None else [row]
        _answer(lambda: client.cancel(list(running)), address, limit_s=_CANCEL_S)
    finally:
        _close(client)


def _outcome(future: Any, job: Job) -> Row | None:
    """Return the row of a future that ended, or None if the cluster lost it."""
    try:
        if future.status == "finished":
            answer = future.result(timeout=10)
        elif future.status == "error":
            error = future.exception(timeout=10)
            if isinstance(error, ChildProcessError):
                return None
            return failed(job, f"its worker ended: {type(error).__name__}: {error}")
        else:
            return None
    except (OSError, TimeoutError, CancelledError):
        return None  # the scheduler ended meanwhile
    return row_in(answer)


def workers_of(address: str) -> int:
    """Return how many runs a cluster works on at a time.

    Raises:
        MissingExtraError: If dask isn't installed.
        SourceError: If no scheduler answers there.
    """
    client = _connected(address, StopRequest(), patience_s=0.0)
    try:
        return _threads(client, address, StopRequest())
    finally:
        _close(client)


def _answer(
    call: Callable[[], Any],
    address: str,
    look: Callable[[], None] = lambda: None,
    limit_s: float | None = None,
) -> Any:
    """Return what a scheduler answers; Dask waits for it without a limit."""
    advice = "it is frozen or out of reach; rows that are done are kept, so start the sweep again"
    what = f"{address}: the Dask scheduler"
    return attended(call, what, advice, limit_s=limit_s or PATIENCE_S, look=look)


class _StoppedError(Exception):
    """A stop was requested while the scheduler was waited for."""


def _threads(client: Any, address: str, stop: StopRequest) -> int:
    """Return how many threads all workers have; 0 where a stop is requested meanwhile."""

    def look() -> None:
        if stop.requested:
            raise _StoppedError

    try:
        info = _answer(lambda: client.scheduler_info(n_workers=-1), address, look)
    except _StoppedError:
        return 0
    workers = info["workers"]
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
            connect = partial(Client, address, timeout=5, set_as_default=False)
            return _answer(connect, address, limit_s=_CONNECT_S)
        except (OSError, TimeoutError, ValueError) as error:
            if time.monotonic() > deadline or stop.requested:
                raise SourceError(address, f"no Dask scheduler answers: {error}") from error
