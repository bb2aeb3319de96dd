"""A sweep on a Dask cluster on loopback whose workers and scheduler are killed."""

import json
import os
import signal
from contextlib import ExitStack

import pytest

from support.dask_cluster import free_port, scheduler, workers
from support.processes import UNDULOG, alive, parent_of, process, undulog, wait_for
from support.sweep_plans import comparable, write_plan
from undulog.replay.sweep.rows import RowStore

STRENGTHS = tuple(0.1 + k / 100 for k in range(20))


def rows_of(output):
    return comparable(RowStore(str(output)).rows())


def wait_for_rows(output, rows):
    wait_for(lambda: len(list(output.glob("pending/*.json"))) >= rows, "rows", 200)


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """The same sweep on the processes of this computer."""
    folder = tmp_path_factory.mktemp("local")
    assert undulog("sweep", write_plan(folder, STRENGTHS), "-o", folder / "rows").returncode == 0
    return rows_of(folder / "rows")


def pids(output):
    """Processes that made the rows that are there, by id, the latest first."""
    files = sorted(output.glob("pending/*.json"), key=lambda file: -file.stat().st_mtime_ns)
    names = [json.loads(file.read_text())["worker"] for file in files]
    return list(dict.fromkeys(int(name.rpartition(":")[2]) for name in names))


@pytest.mark.nightly
def test_rows_are_the_same_though_run_worker_and_scheduler_are_killed(local, tmp_path):
    plan, output, port = write_plan(tmp_path, STRENGTHS), tmp_path / "rows", free_port()
    address = f"tcp://127.0.0.1:{port}"
    words = (*UNDULOG, "sweep", plan, "-o", output, "--cluster", address, "--json")
    seen = set()
    with ExitStack() as stack:
        first = stack.enter_context(scheduler(port))
        stack.enter_context(workers(port, tmp_path / "dask1"))
        sweep = stack.enter_context(process(*words))
        wait_for_rows(output, 2)
        os.kill(pids(output)[0], signal.SIGKILL)
        wait_for_rows(output, 4)
        latest = pids(output)[0]
        os.kill(parent_of(latest), signal.SIGKILL)
        wait_for(lambda: not alive(latest), "a run ends with its worker", 20)
        wait_for_rows(output, 8)
        seen.update(pids(output))
        first.kill()
        first.wait()
        stack.enter_context(scheduler(port))
        stack.enter_context(workers(port, tmp_path / "dask2"))
        out, err = sweep.communicate()
    assert sweep.returncode == 0, err
    report = json.loads(out)
    assert (report["run"], report["failed"], report["complete"]) == (20, 0, True)
    assert err == f"{address}: the scheduler ended; waiting 300 s for another\n"
    assert rows_of(output) == local
    made = {int(row["worker"].rpartition(":")[2]) for row in RowStore(str(output)).rows()}
    assert len(made) > len(seen)
    wait_for(lambda: not any(map(alive, seen | made)), "processes end with their workers", 20)


@pytest.mark.nightly
def test_a_sweep_on_a_cluster_can_be_interrupted_and_goes_on_here(local, tmp_path):
    plan, output, port = write_plan(tmp_path, STRENGTHS), tmp_path / "rows", free_port()
    words = (*UNDULOG, "sweep", plan, "-o", output, "--json")
    cluster = ("--cluster", f"tcp://127.0.0.1:{port}")
    with scheduler(port), workers(port, tmp_path / "dask"), process(*words, *cluster) as sweep:
        wait_for_rows(output, 3)
        sweep.send_signal(signal.SIGINT)
        out, _ = sweep.communicate()
    assert json.loads(out)["complete"] is False
    there = len(rows_of(output))
    rest = json.loads(undulog(*words[3:]).stdout)
    assert (rest["there_before"], rest["run"]) == (there, 20 - there)
    assert rows_of(output) == local


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_named(tmp_path):
    address = f"tcp://127.0.0.1:{free_port()}"
    done = undulog(
        "sweep", write_plan(tmp_path), "-o", tmp_path / "rows", "--cluster", address, code=1
    )
    assert f"{address}: no Dask scheduler answers" in done.stderr
    assert "Traceback" not in done.stderr
