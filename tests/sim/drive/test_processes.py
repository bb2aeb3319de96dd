"""Driving as its users do: virtual robot, recorder and controller, each a process of its own."""

import json
import os
import signal
from contextlib import contextmanager

import numpy as np
import pytest

from support.processes import UNDULOG, process, serving, undulog, wait_for
from undulog.capture import Session
from undulog.capture.common.part_files import unfinished_path
from undulog.capture.log.messages.frames import DIR_TX

pytestmark = pytest.mark.slow

STEP = np.radians(0.01)


@contextmanager
def served(scenario, *words):
    """A virtual robot: its bus's address, and the process."""
    with serving(scenario, *words) as (robot, ready):
        assert ready["event"] == "ready"
        yield f"can:socketcand:{ready['bus']}?host=127.0.0.1&port={ready['port']}", robot


@contextmanager
def recorded(on, path, env):
    """A recorder of that bus, connected."""
    with process(
        *UNDULOG, "record", on, "-r", "snake25", "-o", str(path), "--floor", "0", env=env
    ) as recorder:

        def connected():
            asked = undulog("record", "status", "--json", env=env)
            recordings = json.loads(asked.stdout or "{}").get("recordings", [])
            return any(
                recording["output"] == str(path) and recording["sources"][0]["connected"]
                for recording in recordings
            )

        wait_for(connected, "the recorder", alive=[recorder])
        yield recorder


@pytest.fixture
def alone(tmp_path):
    """An environment in which no other recorder is found."""
    runtime = tmp_path / "run"
    runtime.mkdir()
    return os.environ | {"XDG_RUNTIME_DIR": str(runtime)}


def driven(*words, env):
    """Drive to the end, and return the report.

    The gate rightly ends a drive if this computer stands still for 30 ms, as it does now and then
    where others use it too; that is not what these tests are about, so it may do so twice.
    """
    for _ in range(3):
        done = undulog("drive", *words, "--force", "--json", env=env)
        assert done.stdout, done.stderr
        report = json.loads(done.stdout)
        if (report["fault"] or {}).get("kind") not in ("late", "silent"):
            break
    assert (done.returncode, done.stderr, report["outcome"]) == (0, "", "complete")
    return report


@pytest.mark.clock(0.02, "a robot in another process has to answer within three control ticks")
def test_a_recorder_gets_the_gait_through_its_control_socket(tmp_path, alone):
    path = tmp_path / "recorded.mcap"
    with served("weak-servo-pi3", "--duration", "60") as (on, _), recorded(on, path, alone):
        words = ["drive", "weak-servo-pi3", "--on", on, "--arm", "--duration", "2", "--json"]
        words += ["-o", str(tmp_path / "driven.mcap")]
        report = json.loads(undulog(*words, env=alone, code=0).stdout)
        assert (report["gait_not_told"], report["gait_told"]) == (None, report["ticks"])
        undulog("record", "stop", "--wait", env=alone, code=0)
    with Session.open(path) as session:
        gait = session.joints("/gait")
        notes = [message.msg for _, message in session.messages("/rosout")]
        modes = [message.data for _, message in session.messages("/gait/mode")]
        commands = session.joints("/joint_commands")
        states = session.joints("/joint_states")
        assert session.robot.name == "snake25"
    assert (len(gait.t_ns[0]), modes) == (report["ticks"], ["walk"])
    assert any(text.startswith("drives weak-servo-pi3 (gait) on can:") for text in notes)
    assert any(text.startswith("drove weak-servo-pi3 for 2 s") for text in notes)
    assert len(states.t_ns[0]) > 50
    # Commands on the bus and gait by the control socket tell the same story: what a joint got is
    # what the gait meant in the same tick, rounded to the bus.
    a, omega, lag, offset, phase = np.array(gait.values)
    np.testing.assert_allclose(omega, np.pi)
    np.testing.assert_allclose(lag, -np.pi / 3)
    for place, name in enumerate(("joint01", "joint03", "joint05")):
        meant = held_back(a * np.sin(phase + place * lag) + offset)
        given = commands.signal(name).values
        given = given[~np.isnan(given)]  # a tick's frames that came more than 0.1 s apart
        assert len(given) == report["ticks"]
        assert np.abs(given - meant).max() <= STEP / 2 * (1 + 1e-6)


def held_back(wishes, most=4.0 * 0.01):
    """What the gate lets through: behind ticks that a busy computer leaves out, step by step."""
    given = np.zeros_like(wishes)  # the robot stands straight
    for k, wish in enumerate(wishes):
        before = given[k - 1] if k else 0.0
        given[k] = np.clip(wish, before - most, before + most)
    return given


def test_the_virtual_robot_is_driven_as_any_other_through_python_can(tmp_path, alone):
    path = tmp_path / "a.mcap"
    with served("flat", "--duration", "60") as (on, _):
        words = ("flat", "--on", f"{on}&plain=yes", "--arm", "--duration", "1")
        report = driven(*words, "-o", str(path), env=alone)
    assert report["approach_s"] >= 0.5  # whose bus it is has to be read from it
    assert report["lateness"]["ticks"] + report["overruns"] >= 100
    with Session.open(path) as session:
        sent = session.frames("/can/can0")
        assert len(session.joints("/joint_commands").t_ns[0]) == report["sent"] / 25
        assert (sent["dir"] == DIR_TX).sum() == report["sent"]
        assert session.metadata["undulog"]["clock.can0"] == "host"


@pytest.mark.nightly
def test_of_several_recorders_one_has_to_be_chosen(tmp_path, alone):
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with (
        served("flat", "--duration", "60") as (on, _),
        recorded(on, first, alone),
        recorded(on, second, alone),
    ):
        words = ("flat", "--on", on, "--arm", "--duration", "0.2", "-o", str(tmp_path / "c.mcap"))
        drove = undulog("drive", *words, env=alone, code=2)
        assert "2 recorders run; which one is to receive the gait?" in drove.stderr
        sockets = [line.split()[-1] for line in drove.stderr.splitlines()[1:]]
        assert driven(*words, "--recorder", sockets[1], env=alone)["recorder"] == sockets[1]


@pytest.mark.nightly
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        *(pytest.param(n, marks=pytest.mark.nightly) for n in (signal.SIGINT, signal.SIGHUP)),
    ],
)
def test_a_signal_brings_the_robot_to_rest(tmp_path, number, alone):
    path = tmp_path / "a.mcap"
    part = unfinished_path(path)
    with served("flat", "--lockstep", "--fast") as (on, _):
        words = ("drive", "flat", "--on", on, "--arm", "--duration", "600", "-o", str(path))
        with process(*UNDULOG, *words, env=alone) as driving:
            wait_for(lambda: part.exists() and part.stat().st_size > 200_000, alive=[driving])
            driving.send_signal(number)
            shown, complained = driving.communicate()
    assert driving.returncode == 1
    why = {
        signal.SIGTERM: "stop requested (SIGTERM)",
        signal.SIGINT: "stop requested (Ctrl-C)",
        signal.SIGHUP: "the console is gone",
    }[number]
    assert complained.startswith(f"error: {why}; the joints were brought straight within ")
    assert shown.startswith(f"{on}: stopped at ")
    assert shown.splitlines()[0].endswith(why)
    with Session.open(path) as session:
        commands = np.array(session.joints("/joint_commands").values)
        assert (session.verdict, session.warnings) == ("good", [])
    assert not commands[:, -1].any()
