"""The dry run: its numbers against closed forms and against the session of the same run."""

import dataclasses
import json
import math
import socket

import numpy as np
import pytest

from support import twin_chains
from support.twin_runs import SNAKE25
from support.written_sessions import write_commands
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import SimulationError
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Safety
from undulog.sim.drive.dry_run import DryRunVerdict, dry_run, nominal_world, reported, summary_lines
from undulog.sim.drive.motion import find_motion

RATE_HZ = 100
WIDE = 10_000
STEP = 1e-9


@pytest.fixture(scope="module")
def robot():
    text = twin_chains.chain(4).replace('"simulated"', '"device"').replace('"chain4"', '"short"')
    limits = {"max_rate": 4.0, "ramp_rate": 0.5, "max_tracking_error": 0.35, "max_current": 1.4}
    limits |= {"reply_timeout_s": 0.25, "max_late_s": 0.2}
    return parse_robot(text + twin_chains.toml({"safety": limits}), "short.toml", {})


def recorded(path, robot, commands):
    """Commands of a session, rows at 100 Hz, to be driven."""
    write_commands(path, robot.joint_names, commands, robot=robot, clock={"computer": "host"})
    return find_motion(str(path))


def wave(robot, seconds, amplitude=0.2, frequency_hz=1.0, phase=0.5):
    t = np.arange(round(seconds * RATE_HZ) + 1) / RATE_HZ
    place = np.arange(len(robot.joints))
    return amplitude * np.sin(2 * np.pi * frequency_hz * t[:, None] - 0.4 * place + phase)


@pytest.fixture(scope="module")
def waved(robot, tmp_path_factory):
    """A wave of 1.5 s, run dry, and the twin's session of it."""
    folder = tmp_path_factory.mktemp("dry")
    commands = wave(robot, 1.5)
    path = folder / "twin.mcap"
    return commands, dry_run(recorded(folder / "wave.mcap", robot, commands), output=path), path


def test_ranges_rates_and_accelerations_are_those_of_the_commands(waved, robot):
    commands, run, _ = waved
    # What is commanded before is the first pose.
    steps = np.diff(np.vstack([commands[:1], commands[:1], commands]), axis=0)
    for i, joint in enumerate(run.joints):
        assert joint.name == robot.joint_names[i]
        assert joint.least == pytest.approx(commands[:, i].min(), abs=STEP)
        assert joint.greatest == pytest.approx(commands[:, i].max(), abs=STEP)
        room = robot.joints[i].upper - np.abs(commands[:, i]).max()
        assert joint.margin == pytest.approx(room, abs=STEP)
        assert joint.rate == pytest.approx(RATE_HZ * np.abs(steps[:, i]).max(), rel=1e-9)
        bends = RATE_HZ**2 * np.abs(np.diff(steps[:, i]))
        assert joint.acceleration == pytest.approx(bends.max(), rel=1e-6)
        # 1 Hz of 0.2 rad: 2 pi A, less what the chord of 10 ms is shorter than the tangent.
        assert joint.rate == pytest.approx(0.4 * np.pi, rel=2e-3)


def test_it_would_run_and_the_first_line_says_so(waved):
    _, run, _ = waved
    assert (run.verdict, run.verdict.fit) == (DryRunVerdict.RUNS, True)
    assert (run.duration_s, run.scenario.duration_s, run.missing, run.fault) == (1.5, 1.5, (), None)
    lines = list(summary_lines(run, WIDE))
    assert lines[0].startswith("wave.mcap on short would run as it is; closest to a limit")
    joint, demand = run.closest
    assert demand.share == max(
        demand.share
        for joint in run.joints
        for demand in joint.demands
        if math.isfinite(demand.share)
    )
    assert f"{joint}, {demand.name}" in lines[0]
    assert f"({demand.share:.0%})" in lines[0]


@pytest.mark.parametrize("width", [WIDE, 120, 100, 80, 40])
def test_the_table_is_aligned_and_narrow_terminals_go_without_columns(waved, width):
    _, run, _ = waved
    lines = list(summary_lines(run, width))
    head = next(k for k, line in enumerate(lines) if line.startswith("joint "))
    assert [line.split()[0] for line in lines[head + 1 :]] == [joint.name for joint in run.joints]
    assert len({len(line) for line in lines[head:]}) == 1  # numbers end at one column
    assert len(lines[head]) <= width
    assert len([k for k, title in enumerate(lines[head].split()) if title == "%"]) == 5  # they stay
    assert ("too narrow" in lines[head - 1]) is (width < 110)


def test_the_ramp_to_the_first_pose_is_as_long_as_its_peak_rate_allows(waved, robot):
    commands, run, _ = waved
    np.testing.assert_allclose(run.first_pose, commands[0], atol=STEP)
    # 3 x^2 - 2 x^3 is steepest in its middle, with a slope of 1.5.
    assert run.approach_s == pytest.approx(1.5 * np.abs(commands[0]).max() / robot.safety.ramp_rate)


def test_torque_current_and_energy_are_those_of_the_session_of_that_run(waved):
    _, run, path = waved
    with Session.open(path) as session:
        assert (session.verdict, session.warnings) == ("good", [])
        modes = [(t_ns, m.data) for t_ns, m in session.messages("/gait/mode")]
        notes = [m.msg for _, m in session.messages("/rosout")]
        effort = session.joints("/joint_states", "effort")
        current = session.joints("/joint_current")
        ledger = session.joints("/energy_ledger")
        commands = session.joints("/joint_commands")
    assert [mode for _, mode in modes] == ["reading the pose", "approach", "replay"]
    assert "gate: run" in notes
    begin_ns = modes[-1][0]
    end_ns = begin_ns + round(1.5e9)
    rows = np.array(commands.values)[:, commands.t_ns[0] >= begin_ns]
    for joint, given, torques, currents in zip(
        run.joints, rows, effort.values, current.values, strict=True
    ):
        assert given.max() == pytest.approx(joint.greatest, abs=STEP)
        # What the servos tell comes two ticks late: those of the last two are not in it.
        span = (effort.t_ns[0] >= begin_ns - 10_000_000) & (effort.t_ns[0] <= end_ns - 20_000_000)
        assert np.abs(torques[span]).max() == pytest.approx(joint.torque_peak, rel=1e-12)
        assert np.sqrt(np.mean(torques[span] ** 2)) == pytest.approx(joint.torque_rms, rel=1e-12)
        assert np.abs(currents[span]).max() == pytest.approx(joint.current_peak, rel=1e-12)
    window = (ledger.t_ns[0] >= begin_ns) & (ledger.t_ns[0] <= end_ns)
    names = ("mechanical_net", "mechanical_abs", "electrical_net")
    for name, value in zip(names, run.energy_j, strict=True):
        taken = ledger.signal(name).values[window]
        assert taken[-1] - taken[0] == pytest.approx(value, rel=1e-9)
        assert value > 0.0


def test_json_has_si_units_and_nothing_that_is_no_number(waved):
    _, run, path = waved
    report = json.loads(json.dumps(reported(run), allow_nan=False))
    assert (report["verdict"], report["would_run"], report["armed"]) == ("would run", True, False)
    assert report["path"] == str(path)
    assert report["joints"][0]["greatest"] == run.joints[0].greatest
    assert report["joints"][0]["share"]["rate"] == run.joints[0].rate / 4.0
    assert report["energy_net_j"] == pytest.approx(1.5 * report["power_net_w"])
    assert report["stop"] is None


def test_a_step_would_be_clamped_to_the_greatest_rate(robot, tmp_path, opened):
    commands = np.zeros((60, len(robot.joints)))
    commands[20:, 2] = 0.3
    path = tmp_path / "twin.mcap"
    run = dry_run(recorded(tmp_path / "step.mcap", robot, commands), output=path)
    assert (run.verdict, run.verdict.fit) == (DryRunVerdict.CLAMPED, True)
    assert run.joints[2].rate == pytest.approx(30.0)
    steps = np.diff(opened(path).joints("/joint_commands").signal("joint03").values)
    assert steps.max() == pytest.approx(4.0 / RATE_HZ)  # of [safety] max_rate
    assert (steps > STEP).sum() == 8  # 0.3 rad by 0.04 rad a tick
    # Where it holds back: in seven of sixty ticks, the eighth step is there.
    assert run.joints[2].clamped == pytest.approx(7 / 60)
    assert [joint.name for joint in run.joints if joint.clamped] == ["joint03"]
    first, second = list(summary_lines(run, WIDE))[:2]
    assert first.startswith("step.mcap on short would run, clamped: joint03 12% of the ")
    assert second == "  gate: joint03: command held back to 4 rad/s"


def test_a_servo_that_is_too_weak_would_stop_the_drive(robot, tmp_path):
    driven = recorded(tmp_path / "wave.mcap", robot, wave(robot, 3.0, 0.5))
    world = nominal_world(robot)
    joints = list(robot.joints)
    weak = dataclasses.replace(joints[2].servo, stall_torque=0.01)
    joints[2] = dataclasses.replace(joints[2], servo=weak)
    world = dataclasses.replace(world, robot=dataclasses.replace(robot, joints=tuple(joints)))
    run = dry_run(driven, world=world)
    assert (run.verdict, run.verdict.fit) == (DryRunVerdict.STOPS, False)
    assert (run.fault.kind, run.fault.joint, run.fault.limit) == ("tracking", "joint03", 0.35)
    assert 0.0 <= run.duration_s < 3.0
    first = next(summary_lines(run, WIDE))
    assert "wave.mcap on short would stop " in first
    assert "joint03: tracking error 0." in first
    stop = reported(run)["stop"]
    assert (stop["joint"], stop["kind"]) == ("joint03", "tracking")


def test_limits_that_are_missing_are_named_and_the_numbers_are_there_all_the_same(robot, tmp_path):
    bare = dataclasses.replace(robot, safety=Safety(max_rate=4.0))
    run = dry_run(recorded(tmp_path / "wave.mcap", robot, wave(robot, 0.5)), robot=bare)
    assert run.verdict is DryRunVerdict.REFUSED
    assert run.missing == ("ramp_rate", "max_tracking_error", "reply_timeout_s", "max_late_s")
    assert math.isnan(run.approach_s)
    assert run.joints[0].rate == pytest.approx(0.4 * np.pi, rel=2e-3)
    lines = list(summary_lines(run, WIDE))
    assert "would not start: short lacks the limits ramp_rate, max_track" in lines[0]
    assert "  [safety]" in lines
    assert reported(run)["approach_s"] is None


def test_on_the_command_line_nothing_is_opened(tmp_path, command, report_of, opened):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        on = f"can:socketcand:can0?host=127.0.0.1&port={server.getsockname()[1]}"
        words = ["drive", "weak-servo-pi3", "--on", on, "--duration", "0.3"]
        text = command(*words).out
        assert text.startswith("weak-servo-pi3 on snake25 would run as it is; closest")
        assert "nothing was sent, and no bus opened" in text
        path = tmp_path / "dry.mcap"
        report = report_of(*words, "-o", path)
        assert (report["on"], report["would_run"], report["path"]) == (on, True, str(path))
        with pytest.raises(BlockingIOError):
            server.accept()
    assert opened(path).metadata["undulog"]["dry_run"] == "yes"
    command(*words, "-o", path, code=2)  # it is there


def test_the_exit_code_says_that_it_would_not_run(tmp_path, command):
    scenario = tmp_path / "weak.toml"
    text = SNAKE25.replace("amplitude = 0.3", "amplitude = 0.5")
    scenario.write_text(f"{text}[servo]\nstall_torque = 0.02\n")
    assert command("drive", scenario, "--on", "can:socketcand:can0", code=1).out.startswith(
        "weak on snake25 would stop "
    )
    command("drive", scenario, "--on", "can", code=2)


def test_what_arming_would_refuse_the_dry_run_refuses_too(tmp_path, command):
    on = ("--on", "can:socketcand:can0")
    assert "snake13 has no bus map" in command("drive", "snake13-horizontal-pi3", *on, code=2).err
    whole = load_robot("snake25")
    few = tmp_path / "few.mcap"
    write_commands(few, ("joint01", "joint02"), [np.zeros(2)], robot=whole, clock={"c": "host"})
    err = command("drive", few, *on, code=2).err
    assert "it commands 2 joints: joint01, joint02" in err
    assert "snake25 has 25: joint01, joint02, joint03" in err


def test_a_twin_that_fails_leaves_a_session_that_says_so(robot, tmp_path):
    driven = recorded(tmp_path / "wave.mcap", robot, wave(robot, 0.5))
    world = dataclasses.replace(nominal_world(robot), physics_rate_hz=200)
    path = tmp_path / "twin.mcap"
    with pytest.raises(SimulationError, match="the twin failed at 0"):
        dry_run(driven, world=world, output=path)
    with Session.open(path) as session:
        assert session.verdict == "bad"
        assert any("the twin failed" in m.msg for _, m in session.messages("/rosout"))
