"""Processes that make the runs: kept between runs, ended with the process that started them.

A worker of a Dask cluster is no place for a run. Its threads share one interpreter, and Dask starts
it with ``MALLOC_TRIM_THRESHOLD_``; glibc then maps every larger array anew, 10,000 page faults in a
run that has 100 without. So a run has a process of its own there as well. A worker passes on bytes,
and what a run needs is imported only in that process.
"""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from queue import SimpleQueue
from threading import Thread, Timer
from typing import TYPE_CHECKING

from undulog.capture.common.console import complain
from undulog.capture.common.errors import NoAnswerError, UndulogError
from undulog.capture.common.waits import Standstill, end_process, processor_time

if TYPE_CHECKING:
    from .rows import Row
    from .run import Job, Setting

_IDLE_S = 60.0
"""How long a process is kept for another run [s]."""
STILL_S = 300.0
"""How long a process may compute nothing while it makes a run [s]; a frozen one is ended."""
_ENDED = "the process of a run has ended"
_GRACE_S = 10.0  # to remove what it has written
_LOOK_S = 0.5
_OF_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class RunProcesses:
    """Processes that make runs, as many as threads ask for at a time."""

    def __init__(self) -> None:
        """Start none yet."""
        self._idle: dict[_RunProcess, Timer] = {}

    def run(self, request: bytes) -> bytes:
        """Make a run.

        Args:
            request: As :func:`request_of` gives it.

        Returns:
            The answer, for :func:`row_in`.

        Raises:
            ChildProcessError: If the process that made it has ended, or stood still and was ended.
            NoAnswerError: If it stands still and can't be ended.
        """
        process = self._taken()
        try:
            answer = process.ask(request)
        except (EOFError, OSError) as error:
            process.end()
            still = isinstance(error, TimeoutError)
            raise ChildProcessError(str(error) if still else _ENDED) from error
        timer = self._idle[process] = Timer(_IDLE_S, self._end_idle, [process])
        timer.daemon = True
        timer.start()
        return answer

    def end(self) -> None:
        """End those that are idle."""
        for process in list(self._idle):
            self._end_idle(process)

    def _taken(self) -> _RunProcess:
        while self._idle:
            with suppress(KeyError):  # another thread took the last one
                process, timer = self._idle.popitem()
                timer.cancel()
                if process.runs:
                    return process
                process.end()
        return _RunProcess()

    def _end_idle(self, process: _RunProcess) -> None:
        if timer := self._idle.pop(process, None):
            timer.cancel()
            try:
                process.end()
            except NoAnswerError as error:  # its run is done: this is no fault of the sweep
                complain(str(error))


class _RunProcess:
    def __init__(self) -> None:
        self._connection, other = Pipe()
        self._folder = tempfile.mkdtemp(prefix="undulog-sweep-")  # a killed process leaves files
        environment = os.environ | dict.fromkeys(_OF_THREADS, "1") | {"TMPDIR": self._folder}
        environment.pop("MALLOC_TRIM_THRESHOLD_", None)
        try:
            with other:
                self._process = subprocess.Popen(  # noqa: S603  our own arguments
                    [sys.executable, "-P", "-m", __name__, str(other.fileno()), self._folder],
                    stdin=subprocess.DEVNULL,
                    pass_fds=[other.fileno()],
                    env=environment,
                    process_group=0,  # a Ctrl-C ends it through us
                )
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise

    @property
    def runs(self) -> bool:
        return self._process.poll() is None

    def ask(self, request: bytes) -> bytes:
        self._connection.send_bytes(request)
        still = Standstill(STILL_S)
        while not self._connection.poll(_LOOK_S):
            if still.reached(processor_time([self._process.pid])):
                raise TimeoutError(f"it computed nothing for {STILL_S:g} s and was ended")
        return self._connection.recv_bytes()

    def end(self) -> None:
        self._connection.close()  # its request to end
        try:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_GRACE_S)
            end_process(self._process, "a process of the sweep")
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)


def request_of(setting: Setting, job: Job) -> bytes:
    """Return a run as :meth:`RunProcesses.run` takes it."""
    return pickle.dumps((setting, job))


def row_in(answer: bytes) -> Row:
    """Return the row in an answer.

    Raises:
        UndulogError: As :func:`.run.run_job`.
    """
    row: Row | UndulogError = pickle.loads(answer)  # noqa: S301  of our own process
    if isinstance(row, UndulogError):
        raise row
    return row


_OF_THIS_PROCESS = RunProcesses()


def run_beside(request: bytes) -> bytes:
    """Make a run in a process beside this worker of a cluster, as :meth:`RunProcesses.run`."""
    return _OF_THIS_PROCESS.run(request)


def main(handle: int, folder: str) -> None:
    """Make the runs that are asked for over a connection, until it ends; then remove a folder."""
    from .run import run_job

    connection, requests = Connection(handle), SimpleQueue[bytes]()
    receiver = Thread(target=_receive, args=(connection, requests, folder), daemon=True)
    receiver.start()
    while True:
        setting, job = pickle.loads(requests.get())  # noqa: S301  of our own process
        try:
            answer = run_job(setting, job)
        except UndulogError as error:
            answer = error
        try:
            connection.send_bytes(pickle.dumps(answer))
        except ConnectionError:  # nobody waits for it: the receiver ends this process
            receiver.join()


def _receive(connection: Connection, requests: SimpleQueue[bytes], folder: str) -> None:
    try:
        while True:
            requests.put(connection.recv_bytes())
    except (EOFError, OSError):  # the process that asks has ended, however it did
        for _ in range(100):  # a run that goes on may write there meanwhile
            shutil.rmtree(folder, ignore_errors=True)
            if not Path(folder).exists():
                break
        os._exit(0)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
