"""A session's commands once more on a bus: another process serves it, the gate stands before it."""

from contextlib import contextmanager

import numpy as np
import pytest

import undulog as front
from support.processes import serving
from undulog.capture import Session

STEP = np.radians(0.01)  # of a command on the bus of snake25


@contextmanager
def served(scenario, *words):
    """A virtual robot in lockstep, as fast as it can: its bus's address."""
    with serving(scenario, "--lockstep", "--fast", *words) as (_, ready):
        yield f"can:socketcand:can0?host=127.0.0.1&port={ready['port']}"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """16 s of the twin, settled after 8 s."""
    path = tmp_path_factory.mktemp("again") / "run.mcap"
    assert front.run(["sim", "run", "weak-servo-pi3", "-o", str(path)]) == 0
    return path


@pytest.mark.nightly
def test_on_the_bus_the_same_commands_give_the_same_motion(recorded, tmp_path, report_of):
    path = tmp_path / "again.mcap"
    with served("weak-servo-pi3", "--duration", "60") as on:
        report = report_of("replay", recorded, "--on", on, "--arm", "-o", path)
    assert (report["outcome"], report["kind"], report["armed"]) == ("complete", "commands", True)
    assert report["not_compared"] is None
    with Session.open(recorded) as first, Session.open(path) as second:
        assert second.metadata["undulog"]["driven.session_id"] == first.session_id
        a, b = first.joints("/joint_commands"), second.joints("/joint_commands")
        np.testing.assert_array_equal(a.values, b.values)  # nothing of it had to be cut
        since_ns = [
            np.array(series.t_ns) - session.start_ns
            for series, session in ((a, first), (b, second))
        ]
        np.testing.assert_array_equal(*since_ns)
        assert second.settle_s == first.settle_s
        assert {"/gait", "/gait/mode", "/gate/wanted", "/gate/phase"} <= set(second.channels)
    # Commands are rounded by the bus, and states are: nothing differs by more than that.
    assert report_of("compare", recorded, path) == report["comparison"]


@pytest.mark.nightly
def test_an_early_end_is_reported_and_nothing_is_compared(recorded, tmp_path, command):
    words = ("replay", recorded, "--arm", "-o", tmp_path / "again.mcap", "--on")
    with served("weak-servo-pi3", "--fault", "lost:joint07:1@2") as on:
        out, err = command(*words, on, code=1)
    assert err.startswith("error: joint07 is lost: no angle for more than 0.25 s; the joints")
    assert "stopped at 2.2" in out.splitlines()[0]
    assert "ompared" not in out


def test_a_gait_is_no_session(tmp_path, command):
    words = ("flat", "--on", "can:virtual:x", "--arm", "-o", "x.mcap")
    way = "'undulog drive flat --on can:virtual:x' drives a gait"
    assert way in command("replay", *words, code=2).err
