"""The course of a dry run: where it runs, for how long at most, what it tells and leaves."""

import dataclasses
import itertools
import math
import re
import signal

import numpy as np
import pytest

from support import twin_chains
from undulog.capture import Session
from undulog.capture.common.errors import OutputExistsError, SimulationError
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Safety
from undulog.sim import parse_scenario
from undulog.sim.drive.dry_run import DryRunVerdict, dry_run, joint_table, nominal_world
from undulog.sim.drive.dry_run_gait import JointDemand
from undulog.sim.drive.motion import MotionSource
from undulog.sim.gait.contract import GaitTick
from undulog.sim.twin.stability import warnings

LIMITS = {"max_rate": 4.0, "ramp_rate": 0.5, "max_tracking_error": 0.35}
LIMITS |= {"reply_timeout_s": 0.25, "max_late_s": 0.2}
ROBOT = parse_robot(twin_chains.chain(3) + twin_chains.toml({"safety": LIMITS}), "chain.toml", {})
UPPER = ROBOT.joints[0].upper  # pi / 6, as the lower limits are


class Bent:
    """A gait that stays in a pose and cuts a value after two ticks."""

    names = ("A",)

    def __init__(self, *pose):
        self.pose = np.array(pose)

    def step(self, time_s, readings):
        del readings
        cut = ("horizontal.A",) if time_s > 0.015 else ()
        return GaitTick(self.pose, np.array([time_s]), "bent", cut)


def motion(pose=(0.0, 0.0, 0.0), *, robot=ROBOT, world=None, duration_s=0.05):
    """A pose to be held; the gaits that were made are in ``made``."""
    made = []

    def make(robot, world):
        made.append((robot, world, Bent(*pose)))
        return made[-1][2]

    facts, texts = {"driven": "plan"}, {"plan.toml": b"# bent"}
    source = MotionSource(
        "plan", "bent", robot, lambda: world, duration_s, (), make, facts, texts,
        records={"undulog.plan": {"run": "0"}},
    )  # fmt: skip
    return source, made


def ramp_s(way):
    """How long the way takes: 3 x^2 - 2 x^3 is 1.5 as steep as a line."""
    return 1.5 * way / LIMITS["ramp_rate"]


def test_it_has_the_time_for_the_pose_and_the_longest_ramps_and_ends_with_the_gait(tmp_path):
    driven, made = motion((0.002, 0.0, -0.001))
    path, reported_s = tmp_path / "a.mcap", []
    run = dry_run(driven, output=path, on_time=reported_s.append)
    assert (run.verdict, run.complete, run.started) == (DryRunVerdict.CLAMPED, True, True)
    assert (run.duration_s, run.scenario.duration_s) == (0.05, 0.05)
    assert reported_s[-6:] == [k / 100 for k in range(6)]
    assert set(reported_s[:-6]) == {0.0}  # until the pose is known
    ((robot, world, _),) = made
    assert (robot, world) == (run.scenario.robot, run.scenario)
    assert robot == ROBOT
    assert run.approach_s == pytest.approx(ramp_s(0.002))
    np.testing.assert_array_equal(run.first_pose, [0.002, 0.0, -0.001])
    assert (run.cut, run.missing, run.path) == (("horizontal.A",), (), path)
    assert [text for _, text in run.remarks] == [
        f"gate: {phase}" for phase in ("reading the pose", "run", "done")
    ]
    with pytest.raises(OutputExistsError):
        dry_run(driven, output=path)
    with Session.open(path) as session:
        assert session.verdict == "good"
        facts = session.metadata["undulog"]
        assert (facts["planned_duration_s"], facts["dry_run"]) == ("0.05", "yes")
        assert facts["driven"] == "plan"
        assert session.metadata["undulog.plan"]["run"] == "0"
        assert session.attachments["plan.toml"] == b"# bent"
        ran = parse_scenario(session.attachments["scenario.toml"].decode(), "s", session.robot)
        # The pose has 2 s, and each of two ways may be from limit to limit.
        assert ran.duration_s == pytest.approx(0.05 + 2.0 + 2.0 * ramp_s(2.0 * UPPER))
        texts = [message.msg for _, message in session.messages("/rosout")]
        assert [text for text in texts if text.startswith("gate: ")] == [
            text for _, text in run.remarks
        ]


def test_it_is_stopped_at_the_next_tick_and_then_not_known(tmp_path):
    driven, _ = motion((0.3, 0.0, 0.0), duration_s=86400.0)
    stop, ticks, path = StopRequest(), [], tmp_path / "a.mcap"

    def on_time(time_s):
        ticks.append(time_s)
        if len(ticks) == 3:
            stop.signal = signal.SIGINT

    run = dry_run(driven, output=path, stop=stop, on_time=on_time)
    assert (run.verdict, run.fault, run.started) == (DryRunVerdict.UNFINISHED, None, False)
    assert (run.duration_s, ticks) == (0.0, [0.0] * 3)  # on the way to the first pose
    assert np.isnan(run.joints[0].tracking_error)
    with Session.open(path) as session:
        assert session.verdict == "bad"
        assert "it was stopped" in session.metadata["undulog.health"]["reasons"]
        assert session.joints("/joint_commands").t_ns[0].size == 3
        ran = parse_scenario(session.attachments["scenario.toml"].decode(), "s", session.robot)
        assert ran.duration_s == 86400.0  # a day is the longest there is


def test_a_fault_is_the_verdict_of_its_session(tmp_path):
    strict = dataclasses.replace(ROBOT.safety, max_tracking_error=1e-9, fault_after_s=0.0)
    robot, path = dataclasses.replace(ROBOT, safety=strict), tmp_path / "a.mcap"
    driven, _ = motion((0.1, 0.0, 0.0), duration_s=5.0)
    run = dry_run(driven, robot=robot, output=path)
    assert (run.verdict, run.fault.kind) == (DryRunVerdict.STOPS, "tracking")
    assert not run.complete
    with Session.open(path) as session:
        assert session.verdict == "bad"
        assert run.fault.text in session.metadata["undulog.health"]["reasons"]


def test_a_twin_that_fails_is_raised_and_told_where_there_is_a_session(tmp_path):
    coarse = dataclasses.replace(nominal_world(ROBOT), physics_rate_hz=200)
    driven, _ = motion((0.2, -0.1, 0.2), world=coarse, duration_s=1.0)
    path = tmp_path / "a.mcap"
    for output in (None, path):
        with pytest.raises(SimulationError, match="the twin failed at 0") as failed:
            dry_run(driven, output=output)
    with Session.open(path) as session:
        assert session.verdict == "bad"
        texts = [(message.level, message.msg) for _, message in session.messages("/rosout")]
        assert (40, str(failed.value)) in texts


def test_the_robot_is_that_of_the_world_the_motion_or_the_one_given():
    tall = dataclasses.replace(ROBOT, name="tall")
    world = dataclasses.replace(nominal_world(tall), name="hall", seed=7)
    elsewhere = dataclasses.replace(world, name="elsewhere")
    driven, made = motion(world=world, duration_s=0.02)
    run = dry_run(driven)
    assert (run.scenario.name, run.scenario.robot.name, run.scenario.seed) == ("hall", "tall", 7)
    assert (run.path, run.approach_s) == (None, 0.0)
    run = dry_run(driven, world=elsewhere, robot=ROBOT, duration_s=0.01)
    assert (run.scenario.name, run.scenario.robot.name) == ("elsewhere", "chain3")
    assert (run.scenario.duration_s, run.duration_s) == (0.01, 0.01)
    assert [robot.name for robot, _, _ in made] == ["tall", "chain3"]
    unknown, _ = motion(robot=tall, duration_s=0.01)
    assert dry_run(unknown).scenario.robot.name == "tall"
    assert dry_run(unknown, robot=ROBOT).scenario.robot.name == "chain3"


def test_limits_that_a_robot_lacks_do_not_hold_it_back():
    bare = dataclasses.replace(ROBOT, safety=Safety(max_rate=4.0))
    driven, _ = motion((0.5, 0.0, 0.0), robot=bare, duration_s=0.02)
    run = dry_run(driven)
    assert run.verdict is DryRunVerdict.REFUSED
    assert run.missing == ("ramp_rate", "max_tracking_error", "reply_timeout_s", "max_late_s")
    assert math.isnan(run.approach_s)
    assert math.isnan(run.joints[0].max_tracking_error)
    assert (run.joints[0].max_rate, run.complete) == (4.0, True)
    # The ramp is as fast as the commands may be.
    ramp = next(text for _, text in run.remarks if "approach" in text)
    assert f"{1.5 * 0.5 / 4.0:.2g} s to the first pose" in ramp


def test_a_world_for_a_robot_is_level_still_and_as_fine_as_its_gears_need():
    rates = []
    for light in (1.0, 1e-1, 1e-3):
        links = tuple(
            dataclasses.replace(
                link,
                mass=light * link.mass,
                inertia=tuple(light * moment for moment in link.inertia),
            )
            for link in ROBOT.links
        )
        world = nominal_world(dataclasses.replace(ROBOT, links=links))
        coarser = dataclasses.replace(world, physics_rate_hz=world.physics_rate_hz // 2)
        assert warnings(coarser)
        assert bool(warnings(world)) == (light < 0.01)
        rates.append(world.physics_rate_hz)
    assert rates[0] < rates[1] < rates[2] == 16_000  # an hour at a higher one takes hours
    assert (world.name, world.world.heading, world.robot.name) == ("nominal", 0.0, "chain3")
    ((plane, wave),) = world.gait.planes.items()
    assert (plane, wave.amplitude) == (ROBOT.joints[0].plane, 0.0)


def test_a_first_pose_beyond_a_limit_is_approached_to_the_limit():
    driven, _ = motion((-0.9, 0.2, 0.1), duration_s=0.01)

    def begun(driven):
        stop, left = StopRequest(), iter(range(4))

        def on_time(_):
            if next(left, None) is None:
                stop.signal = signal.SIGINT

        return dry_run(driven, stop=stop, on_time=on_time)

    assert begun(driven).approach_s == pytest.approx(ramp_s(UPPER))
    joints = tuple(dataclasses.replace(joint, lower=0.1, upper=0.4) for joint in ROBOT.joints)
    bent = dataclasses.replace(ROBOT, joints=joints)  # straight is beyond a limit
    driven, _ = motion((0.3, 0.2, 0.1), robot=bent, duration_s=0.01)
    assert begun(driven).approach_s == pytest.approx(ramp_s(0.2))


def test_a_narrow_terminal_goes_without_what_says_least_first():
    values = {field.name: 0.5 for field in dataclasses.fields(JointDemand)}
    joint, heads = JointDemand(**values | {"name": "joint01", "lower": -1.0}), []
    for width in range(150, 20, -3):
        head = re.split(r"\s{2,}", list(joint_table((joint,), width))[1].strip())
        heads += [head] if [head] != heads[-1:] else []
    lost = [
        {title for title in before if title not in after}
        for before, after in itertools.pairwise(heads)
    ]
    assert lost == [
        {"°/s²"}, {"rms", "abs J"}, {"net J", "el. J", "clamped"}, {"from °", "to °"},
        {"°/s", "error °", "N m", "A"},
    ]  # fmt: skip
    assert heads[-1] == ["joint", *["%"] * 5]
