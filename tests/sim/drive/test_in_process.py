"""Driving the twin in process: how a gait fades to rest, and what a run of it calls and keeps."""

import dataclasses
import signal

import numpy as np
import pytest

from undulog import sim
from undulog.capture import Session
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.model import Plane
from undulog.sim.drive.in_process import FadingGait, drive_twin
from undulog.sim.drive.motion import MotionSource


def test_fading_shrinks_amplitude_and_offset_and_leaves_the_phase(make_robot):
    robot = make_robot(5, planar=True)
    wave = sim.Serpentine({Plane.HORIZONTAL: sim.PlaneGait(0.3, 1.0, 0.5, offset=0.1)}, ramp_s=0.0)
    full, faded = (
        sim.SerpentineGait(wave, robot),
        FadingGait(sim.SerpentineGait(wave, robot), robot, 0.5),
    )
    nothing = sim.Readings.nothing(robot)
    for k in range(160):  # whatever the rounding of times: 0.5 s are 50 ticks
        expected, tick = full.step(k / 100, nothing), faded.step(k / 100, nothing)
        if k == 99:
            faded.begin()
        x = min(max((k - 100) / 50, 0.0), 1.0)
        share = 1.0 - x * x * (3.0 - 2.0 * x)
        np.testing.assert_allclose(tick.command, share * expected.command, atol=1e-8)
        np.testing.assert_allclose(
            tick.values, expected.values * [share, 1, 1, share, 1], atol=1e-8
        )
        assert tick.mode == ("walk" if k < 100 else "stop")
        assert faded.at_rest == (k >= 150)


class Adaptive:
    """A gait that reports what a controller may: values of joints, and infinity."""

    names = ("horizontal.A", "joint02.offset", "joint02.phase", "steer.offset", "steer.distance")

    def step(self, time_s, readings):
        del time_s, readings
        return sim.GaitTick(np.full(4, 0.2), np.array([0.4, 0.1, 2.0, 0.3, np.inf]), "avoid", ())


def test_fading_leaves_what_a_controller_reports_of_itself(make_robot):
    robot = make_robot(5)
    gait = FadingGait(Adaptive(), robot)
    gait.begin()
    first, half, last = (gait.step(t, sim.Readings.nothing(robot)) for t in (0.0, 0.5, 1.0))
    assert first.values.tolist() == [0.4, 0.1, 2.0, 0.3, np.inf]
    assert half.values == pytest.approx([0.2, 0.05, 2.0, 0.3, np.inf])
    assert last.values.tolist() == [0.0, 0.0, 2.0, 0.3, np.inf]
    assert half.command == pytest.approx(np.full(4, 0.1))


def test_rest_is_as_straight_as_the_joints_can_be(make_robot):
    """Of joints that can't be straight it is the limit next to that."""
    robot = make_robot(4)
    limits = ((0.1, 0.5), (-0.5, -0.2), (-0.3, 0.3))
    joints = tuple(
        dataclasses.replace(joint, lower=lower, upper=upper)
        for joint, (lower, upper) in zip(robot.joints, limits, strict=True)
    )

    class Bent(Adaptive):
        def step(self, time_s, readings):
            return super().step(time_s, readings)._replace(command=np.array([0.3, -0.4, 0.2]))

    gait = FadingGait(Bent(), dataclasses.replace(robot, joints=joints))
    nothing = sim.Readings.nothing(robot)
    assert gait.step(3.0, nothing).mode == "avoid"
    assert not gait.at_rest
    gait.begin()
    for time_s, expected in (
        (3.1, (0.3, -0.4, 0.2)), (3.6, (0.2, -0.3, 0.1)), (4.0999999, None),
        (4.1, (0.1, -0.2, 0.0)), (9.0, (0.1, -0.2, 0.0)),
    ):  # fmt: skip
        gait.begin()  # again: it goes on
        tick = gait.step(time_s, nothing)
        if expected is not None:
            np.testing.assert_allclose(tick.command, expected, atol=1e-8)
        assert gait.at_rest == (time_s >= 4.1)


def waving(make_scenario, make_robot, duration_s):
    """A wave of three joints, and the world in which it is driven."""
    scenario = make_scenario(make_robot(4)).changed(duration_s=duration_s)
    driven = MotionSource(
        "gait", "wave", scenario.robot, lambda: scenario, duration_s, (),
        lambda robot, world: sim.SerpentineGait(world.gait, robot), {"driven": "gait"},
        {"gait.toml": b"# a wave"}, records={"undulog.plan": {"run": "3"}},
    )  # fmt: skip
    return driven, scenario


def test_a_drive_ends_at_its_time_and_calls_with_each_sample(make_scenario, make_robot, tmp_path):
    driven, scenario = waving(make_scenario, make_robot, 0.05)
    seen, path = [], tmp_path / "a.mcap"
    result = drive_twin(driven, scenario, path, stop=StopRequest(), on_sample=seen.append)
    assert (result.path, result.complete, result.sample_count) == (path, True, 6)
    assert [sample.tick for sample in seen] == list(range(6))
    again = drive_twin(driven, scenario, path, force=True)
    assert (again.complete, again.session_id) == (True, result.session_id)
    with pytest.raises(FileExistsError):
        drive_twin(driven, scenario, path)
    with Session.open(path) as session:
        assert session.metadata["undulog"]["driven"] == "gait"
        assert session.metadata["undulog.plan"]["run"] == "3"
        assert session.attachments["gait.toml"] == b"# a wave"


def test_asked_to_stop_a_drive_goes_on_until_it_is_at_rest(make_scenario, make_robot, tmp_path):
    driven, scenario = waving(make_scenario, make_robot, 60.0)
    stop = StopRequest()

    def on_sample(sample):
        if sample.tick == 3:
            stop.signal = signal.SIGTERM

    result = drive_twin(driven, scenario, tmp_path / "a.mcap", stop=stop, on_sample=on_sample)
    # From the step after that sample on it fades, for 100 steps; then it is held.
    assert (result.complete, result.sample_count) == (False, 4 + 101)
    with Session.open(tmp_path / "a.mcap") as session:
        modes = [(t_ns - session.start_ns, m.data) for t_ns, m in session.messages("/gait/mode")]
        commands = np.array(session.joints("/joint_commands").values)
    assert modes == [(0, "walk"), (40_000_000, "stop")]
    assert not commands[:, -1].any()
    assert commands[:, -2].any()
