"""A session's commands once more on a bus: another process serves it, the gate stands before it."""

import json
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

import undulog as front
from undulog.capture import Session

STEP = np.radians(0.01)  # of a command on the bus of snake25


@contextmanager
def served(scenario, *words):
    """A virtual robot in lockstep, as fast as it can: its bus's address."""
    command = [sys.executable, "-m", "undulog", "sim", "serve", scenario, "--socketcand", "0"]
    with subprocess.Popen(
        [*command, "--lockstep", "--fast", "--json", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as robot:
        try:
            ready = json.loads(robot.stdout.readline())
            yield f"can:socketcand:can0?host=127.0.0.1&port={ready['port']}"
        finally:
            robot.terminate()
            robot.communicate(timeout=60)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """16 s of the twin, settled after 8 s."""
    path = tmp_path_factory.mktemp("again") / "run.mcap"
    assert front.run(["sim", "run", "weak-servo-pi3", "-o", str(path)]) == 0
    return path


@pytest.mark.slow
def test_on_the_bus_the_same_commands_give_the_same_motion(recorded, tmp_path, capsys, report_of):
    path = tmp_path / "again.mcap"
    capsys.readouterr()
    with served("weak-servo-pi3", "--duration", "60") as on:
        words = ["replay", str(recorded), "--on", on, "--arm", "-o", str(path), "--json"]
        assert front.run(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["outcome"], report["kind"], report["armed"]) == ("complete", "commands", True)
    assert report["not_compared"] is None
    with Session.open(recorded) as first, Session.open(path) as second:
        assert second.metadata["undulog"]["driven.session_id"] == first.session_id
        a, b = first.joints("/joint_commands"), second.joints("/joint_commands")
        np.testing.assert_array_equal(a.values, b.values)  # nothing of it had to be cut
        np.testing.assert_array_equal(
            np.array(a.t_ns) - first.start_ns, np.array(b.t_ns) - second.start_ns
        )
        assert second.settle_s == first.settle_s
        assert {"/gait", "/gait/mode", "/gate/wanted", "/gate/phase"} <= set(second.channels)
    # Commands are rounded by the bus, and states are: nothing differs by more than that.
    assert report_of("compare", recorded, path) == report["comparison"]


@pytest.mark.slow
def test_an_early_end_is_said_and_nothing_is_compared(recorded, tmp_path, capsys):
    path = tmp_path / "again.mcap"
    capsys.readouterr()
    with served("weak-servo-pi3", "--fault", "lost:joint07:1@2") as on:
        assert front.run(["replay", str(recorded), "--on", on, "--arm", "-o", str(path)]) == 1
    told = capsys.readouterr()
    assert told.err.startswith("error: joint07 is lost: no angle for more than 0.25 s; the joints")
    assert "stopped at 2.2" in told.out.splitlines()[0]
    assert "ompared" not in told.out


def test_a_gait_is_no_session(tmp_path, command):
    assert (
        "'undulog drive flat --on can:virtual:x' drives a gait"
        in command("replay", "flat", "--on", "can:virtual:x", "--arm", "-o", "x.mcap", code=2).err
    )
