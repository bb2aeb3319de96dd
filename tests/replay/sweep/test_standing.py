"""Runs and Dask schedulers that stand still are given up within the limit, with a sentence."""

import os
import sys

import pytest

from support.dask_cluster import free_port, scheduler, workers
from support.processes import alive, freeze, process
from support.sweep_plans import write_plan
from undulog.replay.sweep import processes
from undulog.replay.sweep.plan import read_plan
from undulog.replay.sweep.processes import RunProcesses, request_of
from undulog.replay.sweep.sweep import prepare

SWEEP = """
import sys
from pathlib import Path
from undulog.capture.common.errors import NoAnswerError
from undulog.capture.common.process import StopRequest
from undulog.replay.sweep import workers
from undulog.replay.sweep.plan import read_plan
from undulog.replay.sweep.sweep import prepare
plan, address, workers.PATIENCE_S = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3])
sweep = prepare(read_plan(plan), plan.parent, str(plan.parent / "rows"))
try:
    for row in workers.run_on_cluster(sweep.setting, sweep.jobs, address, StopRequest()):
        print("a row", flush=True)
        workers.PATIENCE_S = 8.0
except NoAnswerError as error:
    print(error, flush=True)
"""


@pytest.fixture
def sweep(tmp_path):
    return prepare(read_plan(write_plan(tmp_path)), tmp_path, str(tmp_path / "rows"))


@pytest.mark.slow
def test_a_process_that_stands_still_during_a_run_is_ended(sweep, monkeypatch):
    monkeypatch.setattr(processes, "STILL_S", 2.0)
    monkeypatch.setattr(processes, "_GRACE_S", 0.2)
    frozen = []

    class Frozen(processes._RunProcess):
        def ask(self, request):
            freeze(self._process.pid)
            frozen.append((self._process.pid, self._folder))
            return super().ask(request)

    monkeypatch.setattr(processes, "_RunProcess", Frozen)
    with pytest.raises(ChildProcessError, match=r"computed nothing for 2 s and was ended"):
        RunProcesses().run(request_of(sweep.setting, sweep.jobs[0]))
    ((pid, folder),) = frozen
    assert (alive(pid), os.path.exists(folder)) == (False, False)  # noqa: PTH110


@pytest.mark.nightly
def test_a_cluster_without_workers_is_given_up(tmp_path):
    port = free_port()
    with scheduler(port), swept(tmp_path, port, 8.0) as sweep:
        out, _ = sweep.communicate()
    assert out.startswith(f"tcp://127.0.0.1:{port}: a worker of the cluster did not answer within")


@pytest.mark.slow
def test_a_scheduler_that_stands_still_is_given_up(tmp_path):
    port = free_port()
    with (
        scheduler(port) as running,
        workers(port, tmp_path / "dask", 1) as others,
        swept(tmp_path, port, 250.0) as sweep,
    ):
        assert sweep.stdout.readline() == "a row\n", others.poll()
        freeze(running.pid)
        out, err = sweep.communicate()
    assert out.startswith(f"tcp://127.0.0.1:{port}: the Dask scheduler did not answer within 8 s; ")
    assert (err, sweep.returncode) == ("", 0)


def swept(folder, port, patience_s):
    """Sweep on a cluster in a process of its own; it prints its error.

    Args:
        patience_s: Its limit until the first row [s]; then it is 8 s.
    """
    plan = write_plan(folder, [0.1 + k / 100 for k in range(40)])
    return process(sys.executable, "-c", SWEEP, plan, f"tcp://127.0.0.1:{port}", patience_s)
