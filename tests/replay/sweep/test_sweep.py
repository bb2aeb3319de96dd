"""Sweeps on the processes of this computer: interrupted, extended, with failing runs."""

import json
import os
import shutil
import signal

import pandas as pd
import pytest

import undulog as front
from support.processes import UNDULOG, alive, process, run, undulog, wait_for
from support.sweep_plans import comparable, write_plan
from undulog.analysis.session.analyse import analyse_session
from undulog.capture import Session
from undulog.replay.sweep.plan import read_plan
from undulog.replay.sweep.rows import RowStore
from undulog.replay.sweep.sweep import prepare, run_sweep
from undulog.replay.sweep.workers import LocalWorkers

STRENGTHS = (0.1, 0.15, 0.2, 0.25, 0.3)


def swept(plan, output, *words):
    """Run a sweep by one worker, whose start takes as long as a few runs; return its report."""
    done = undulog("sweep", plan, "-o", output, "--json", "--workers", "1", *words)
    assert done.stdout, done.stderr
    assert done.returncode >= 0, done.stderr
    return json.loads(done.stdout), done.returncode


def rows_of(output):
    return comparable(RowStore(str(output)).rows())


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A sweep of ten runs by one worker, sessions kept: its plan's folder and its rows."""
    folder = tmp_path_factory.mktemp("reference")
    plan = write_plan(folder, STRENGTHS, seeds=2, top="sessions = true")
    report, code = swept(plan, folder / "rows")
    assert code == 0
    assert report["run"] == report["planned"] == 10
    return folder


@pytest.mark.nightly
def test_a_row_is_what_the_commands_give_one_by_one(reference, tmp_path, command, report_of):
    frame = pd.read_parquet(reference / "rows" / "rows")
    row = frame[(frame["servo.stall_torque"] == 0.2) & (frame.seed == 1)].iloc[0]
    path = tmp_path / "run.mcap"
    words = ("--set", "servo.stall_torque=0.2", "--seed", "1", "-o", path)
    command("sim", "run", reference / "wave.toml", *words)
    result = report_of("analyse", path)
    assert row.sentence == result["answer"]["sentence"]
    assert list(row.joint) == [joint["name"] for joint in result["joints"]]
    assert list(row.gain) == [joint["gain"] for joint in result["joints"]]
    assert row.lag_sd == result["heterogeneity"]["lag_sd"]["value"]
    kept = reference / "rows" / row.session
    assert kept.read_bytes() == path.read_bytes()
    with Session.open(kept) as session:
        assert session.session_id == row.session_id
        assert analyse_session(session).answer.sentence == row.sentence


@pytest.mark.nightly
def test_what_is_there_is_not_run_again_and_what_is_new_is(reference, tmp_path):
    plan = write_plan(tmp_path, (0.1, 0.2), seeds=2)
    first, _ = swept(plan, tmp_path / "rows")
    assert (first["run"], first["there_before"]) == (4, 0)
    again, _ = swept(plan, tmp_path / "rows")
    assert (again["run"], again["there_before"], again["complete"]) == (0, 4, True)
    plan = write_plan(tmp_path, STRENGTHS[::-1], seeds=2, top="sessions = true")
    longer, _ = swept(plan, tmp_path / "rows")
    assert (longer["run"], longer["there_before"]) == (10, 0)  # the sessions were missing
    assert rows_of(tmp_path / "rows") == rows_of(reference / "rows")
    assert len(list((tmp_path / "rows" / "sessions").glob("*.mcap"))) == 10


@pytest.mark.slow
def test_a_dry_run_runs_nothing(reference, tmp_path, command, report_of):
    plan = reference / "plan.toml"
    printed = command("sweep", plan, "-o", tmp_path / "rows", "--dry-run").out
    assert "10 runs of 2 s: 5 points of a grid design, 2 seeds each" in printed
    assert "to run: 10" in printed
    assert not (tmp_path / "rows").exists()
    there = report_of("sweep", plan, "-o", reference / "rows", "--dry-run")
    assert (there["to_run"], there["estimated_s"]) == (0, 0)


@pytest.mark.nightly
def test_a_failed_run_keeps_its_error_and_can_be_run_again(tmp_path):
    plan = write_plan(tmp_path, (0.3, -1.0, "strong", 0.2))
    report, code = swept(plan, tmp_path / "rows")
    assert code == 0
    assert (report["run"], report["failed"], report["complete"]) == (4, 2, True)
    frame = pd.read_parquet(tmp_path / "rows" / "rows").set_index("servo.stall_torque")
    assert "ScenarioError" in frame.loc["-1.0", "error"]
    assert "stall_torque" in frame.loc["strong", "error"]
    assert frame.loc["0.3", "status"] == "done"
    again, _ = swept(plan, tmp_path / "rows")
    assert (again["run"], again["failed"]) == (0, 2)
    again, _ = swept(plan, tmp_path / "rows", "--retry-failed")
    assert (again["run"], again["failed"], again["there_before"]) == (2, 2, 2)
    assert pd.read_parquet(tmp_path / "rows" / "rows").key.is_unique


@pytest.mark.nightly
def test_parameters_of_robot_and_analysis(tmp_path):
    plan = write_plan(tmp_path, (0.3,))
    plan.write_text(
        plan.read_text() + '[parameters."robot.chain.joints"]\nvalues = [2, 4]\n'
        '[parameters."analysis.start_s"]\nvalues = [0.0, 0.5]\n'
    )
    report, _ = swept(plan, tmp_path / "rows")
    assert report["failed"] == 0
    frame = pd.read_parquet(tmp_path / "rows" / "rows")
    assert frame.gain.map(len).to_list() == frame["robot.chain.joints"].to_list()
    same = frame.groupby("robot.chain.joints").session_id.nunique()
    assert same.eq(1).all()  # the analysis changes no session
    assert frame.gain.map(lambda gain: gain[0]).nunique() == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("servo.stall_torque", "servo.stal_torque"), "stal_torque"),
        (("servo.stall_torque", "robot.chian.joints"), "chian"),
        (("servo.stall_torque", "analysis.strat_s"), "strat_s"),
        (('"wave.toml"', '"wvae"'), "wvae"),
    ],
)
def test_a_key_that_is_none_is_refused_before_anything_runs(change, message, tmp_path, capsys):
    plan = write_plan(tmp_path)
    plan.write_text(plan.read_text().replace(*change))
    assert front.run(["sweep", str(plan), "-o", str(tmp_path / "rows")]) in (1, 2)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "rows").exists()


def _begun(output, rows=1):
    """Wait until rows are there."""
    wait_for(lambda: len(rows_of(output)) >= rows, "rows", 120)


def _workers(parent):
    """Processes that work for a sweep, by id."""
    return [int(word) for word in run("pgrep", "-P", parent, "-f", "processes").stdout.split()]


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A folder for temporary files, of which none may be left."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    yield folder
    wait_for(lambda: not list(folder.iterdir()), "temporary files are removed", 20)


@pytest.mark.nightly
@pytest.mark.usefixtures("temporary")
@pytest.mark.parametrize(
    "signals",
    [("SIGINT", "SIGKILL"), pytest.param(("SIGTERM", "SIGINT"), marks=pytest.mark.nightly)],
)
def test_a_sweep_that_was_interrupted_twice_goes_on_where_it_stopped(signals, reference, tmp_path):
    plan = write_plan(tmp_path, STRENGTHS, seeds=2, top="sessions = true")
    words = (*UNDULOG, "sweep", plan, "-o", tmp_path / "rows", "--workers", "2", "--json")
    before = 0
    for name in signals:
        with process(*words) as sweep:
            _begun(tmp_path / "rows", before + 1)
            workers = _workers(sweep.pid)
            assert len(workers) == 2
            sweep.send_signal(signal.Signals[name])
            out, errors = sweep.communicate()
        there = len(rows_of(tmp_path / "rows"))
        assert before < there < 10
        if name != "SIGKILL":
            report = json.loads(out)
            assert (report["run"], report["there_before"]) == (there - before, before)
            assert (report["complete"], sweep.returncode) == (False, 1), errors
        wait_for(lambda: not any(map(alive, workers)), "workers end", 20)  # noqa: B023
        before = there
    rest, code = swept(plan, tmp_path / "rows")
    assert (rest["there_before"], rest["run"], code) == (there, 10 - there, 0)
    assert rows_of(tmp_path / "rows") == rows_of(reference / "rows")


@pytest.mark.nightly
@pytest.mark.usefixtures("temporary")
def test_a_worker_that_is_killed_takes_no_row_with_it(reference, tmp_path):
    plan = write_plan(tmp_path, STRENGTHS, seeds=2, top="sessions = true")
    words = (*UNDULOG, "sweep", plan, "-o", tmp_path / "rows", "--workers", "2", "--json")
    with process(*words) as sweep:
        _begun(tmp_path / "rows")
        os.kill(_workers(sweep.pid)[0], signal.SIGKILL)
        out, err = sweep.communicate()
    report = json.loads(out)
    assert (report["run"], report["failed"], err) == (10, 0, "")
    assert rows_of(tmp_path / "rows") == rows_of(reference / "rows")


def bad_rows(folder):
    """Flip 40 bytes of a row file."""
    path = min((folder / "rows").iterdir())
    data = bytearray(path.read_bytes())
    for at in range(60, 100):
        data[at] ^= 0x10
    path.write_bytes(data)


@pytest.mark.slow
def test_damaged_rows_are_reported_set_aside_and_run_again(reference, tmp_path):
    shutil.copytree(reference / "rows", tmp_path / "rows")
    bad_rows(tmp_path / "rows")
    words = ("sweep", reference / "plan.toml", "-o", tmp_path / "rows", "--workers", "1")
    shown = undulog(*words, "--dry-run").stdout
    assert "to run: 10" in shown
    assert "Damaged, with runs to make again: rows/" in shown
    done = undulog(*words)
    assert done.returncode == 0
    assert "checksum" in done.stderr
    assert "moved to damaged/" in done.stderr
    assert "10 of 10 runs, 10 of them now" in done.stdout
    assert "1 damaged file of rows set aside" in done.stdout
    assert rows_of(tmp_path / "rows") == rows_of(reference / "rows")
    assert len(pd.read_parquet(tmp_path / "rows" / "rows")) == 10


@pytest.mark.slow
def test_rows_damaged_during_the_sweep_are_not_called_complete(tmp_path):
    plan = read_plan(write_plan(tmp_path, (0.2,)))
    store = RowStore(str(tmp_path / "rows"))
    first = run_sweep(prepare(plan, tmp_path, store.where), store, workers=1)
    assert first.complete
    longer = read_plan(write_plan(tmp_path, (0.2, 0.3)))
    report = run_sweep(
        prepare(longer, tmp_path, store.where),
        store,
        workers=1,
        on_row=lambda _row, _before: bad_rows(tmp_path / "rows"),
    )
    assert (report.complete, report.missing, len(report.damaged)) == (False, 1, 1)
    again = run_sweep(prepare(longer, tmp_path, store.where), store, workers=1)
    assert (again.complete, again.run, again.damaged) == (True, 1, ())


@pytest.mark.nightly
def test_sweeps_in_turn_share_the_processes(tmp_path):
    """Also where one of them is killed between two sweeps."""
    plan, seen = read_plan(write_plan(tmp_path)), []
    with LocalWorkers(1) as workers:
        for number in range(3):
            output = str(tmp_path / f"rows{number}")
            report = run_sweep(prepare(plan, tmp_path, output), RowStore(output), workers=workers)
            assert (report.run, report.failed) == (2, 0)
            (worker,) = {row["worker"] for row in RowStore(output).rows()}
            seen.append(worker)
            if number == 1:
                os.kill(int(worker.rpartition(":")[2]), signal.SIGKILL)
    assert seen[0] == seen[1] != seen[2]
