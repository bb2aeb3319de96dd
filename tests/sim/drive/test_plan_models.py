"""Random plans against the sums of their own formulas, and what their files may hold."""

import functools
import math
import random
from pathlib import Path

import numpy as np
import pytest

from undulog.capture.common.errors import PlanError
from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, load_scenario
from undulog.sim.drive import plan as module
from undulog.sim.drive.plan import Plan, PlanGait, PlanSegment, parse_plan
from undulog.sim.gait.contract import Modulation
from undulog.sim.gait.wave import Wave

PLANES = (Plane.HORIZONTAL, Plane.VERTICAL)
quick = functools.cache(load_scenario)


@pytest.fixture(autouse=True)
def _read_once(monkeypatch):
    """Read a shipped scenario once for all plans."""
    monkeypatch.setattr(module, "load_scenario", quick)


def wave(chance, phase=0.0):
    return PlaneGait(
        chance.uniform(0.05, 0.15), chance.uniform(0.2, 2.0), chance.uniform(0.1, 1.5),
        offset=chance.uniform(-0.1, 0.1), phase=phase,
        wave=chance.choice(list(Wave)),
    )  # fmt: skip


def share_of(since_s, ramp_s):
    if ramp_s == 0.0:
        return float(since_s >= 0.0)
    x = min(max(since_s / ramp_s, 0.0), 1.0)
    return 3 * x**2 - 2 * x**3


def of(gait):
    """Amplitude, offset, lag from joint to joint and rate of a plane."""
    lag = -gait.lag if gait.wave is Wave.HEAD_TO_TAIL else gait.lag
    return np.array([gait.amplitude, gait.offset, lag, math.tau * gait.frequency_hz])


@pytest.mark.parametrize("seed", range(3))
def test_each_joints_values_are_those_of_the_formulas(seed, make_scenario, make_robot):
    chance, robot = random.Random(seed), make_robot(8)
    start = {plane: wave(chance, chance.uniform(-3, 3)) for plane in PLANES}
    segments = []
    for number in range(3):
        length_s = chance.choice([0.2, 0.35, 0.5])
        transition_s = chance.choice([0.0, 0.1, length_s])
        planes = {plane: wave(chance) for plane in PLANES}
        segments.append(PlanSegment(length_s, planes, transition_s, f"part{number}"))
    ramp_s = chance.choice([0.0, 0.4])
    plan = Plan("p", "d", make_scenario(), start, ramp_s, tuple(segments))
    assert plan.duration_s == pytest.approx(sum(segment.duration_s for segment in segments))
    gait = PlanGait(plan, robot, per_joint=True)
    factors, offsets = (
        np.array([chance.uniform(*span) for _ in robot.joints]) for span in ((0.5, 1), (0, 0.05))
    )
    begun_s = [0.0, segments[0].duration_s, segments[0].duration_s + segments[1].duration_s]
    phases = {plane: start[plane].phase for plane in PLANES}
    rates = {plane: of(start[plane])[3] for plane in PLANES}
    for tick in range(140):
        time_s = tick / 100
        if tick == 60:
            gait.modulate(Modulation(factors, offsets, 1.25))
        changed = tick >= 60
        gait_tick = gait.step(time_s, Readings.nothing(robot))
        values = dict(zip(gait.names, gait_tick.values.tolist(), strict=True))
        number = sum(begun <= time_s for begun in begun_s) - 1
        assert (gait_tick.mode, gait_tick.clamped) == (f"part{number}", ())
        share = share_of(time_s - begun_s[number], segments[number].transition_s)
        for plane in PLANES:
            before = start[plane] if number == 0 else segments[number - 1].planes[plane]
            after = segments[number].planes[plane]
            a, y, lag, omega = of(before) + (of(after) - of(before)) * share
            a, y = share_of(time_s, ramp_s) * np.array([a, y])
            omega *= 1.25 if changed else 1.0
            phases[plane] += rates[plane] * (0.01 if tick else 0.0)
            rates[plane] = omega
            assert abs(values[f"{plane}.omega"] - omega) < 1e-9
            assert abs(values[f"{plane}.lag"] - lag) < 1e-9
            joints = [k for k, joint in enumerate(robot.joints) if joint.plane is plane]
            for place, k in enumerate(joints):
                name, phase = robot.joint_names[k], phases[plane] + place * lag
                amplitude = a * (factors[k] if changed else 1.0)
                offset = y + (offsets[k] if changed else 0.0)
                reported = [values[f"{name}.{key}"] for key in ("A", "offset", "phase")]
                reported += [gait_tick.command[k]]
                formulas = amplitude, offset, phase, amplitude * math.sin(phase) + offset
                assert all(abs(a - b) < 1e-9 for a, b in zip(reported, formulas, strict=True))


def test_values_of_single_joints_are_told_where_they_are_asked_for(make_scenario, make_robot):
    chance, robot = random.Random(1), make_robot(4)
    start = {Plane.HORIZONTAL: wave(chance)}
    plan = Plan("p", "d", make_scenario(), start, 0.0, (PlanSegment(1.0, start),))
    names = {name.partition(".")[0] for name in PlanGait(plan, robot).names}
    assert names == {"horizontal"}
    assert (plan.segments[0].transition_s, plan.segments[0].mode) == (1.0, "walk")


# -- files --------------------------------------------------------------------------------------

HEAD = 'description = "d"\nscenario = "flat"\n'


def parts(*durations_s, more=""):
    return "".join(f"[[segments]]\nduration_s = {duration_s}\n{more}" for duration_s in durations_s)


def faults(text, source="p.toml"):
    with pytest.raises(PlanError) as caught:
        parse_plan(text, Path(source))
    assert len(caught.value.faults) > 0
    return {fault.key: str(fault) for fault in caught.value.faults}


def test_all_segments_together_are_a_day_at_most():
    assert parse_plan(HEAD + parts(86399.0, 1.0), Path("p.toml")).duration_s == 86400.0
    assert list(faults(HEAD + parts(86399.0, 1.5))) == ["segments"]
    (fault,) = faults(HEAD + parts(50_000.0, 50_000.0)).values()
    assert "at most 86400 s together" in fault


def test_a_change_takes_a_second_but_no_longer_than_its_segment():
    plan = parse_plan(HEAD + parts(0.5, 1.0, 3.0), Path("p.toml"))
    assert [segment.transition_s for segment in plan.segments] == [0.5, 1.0, 1.0]
    plan = parse_plan(HEAD + parts(3.0, more="transition_s = 3.0\n"), Path("p.toml"))
    assert plan.segments[0].transition_s == 3.0
    assert list(faults(HEAD + parts(3.0, more="transition_s = 3.01\n"))) == [
        "segments[0].transition_s"
    ]


@pytest.mark.parametrize(
    ("source", "name"), [("turn-2.toml", "turn-2"), ("2nd.toml", "plan"), ("my plan.toml", "plan")]
)
def test_a_plan_is_named_after_its_file_where_that_is_a_name(source, name):
    assert parse_plan(HEAD + parts(1.0), Path(source)).name == name
    named = 'name = "own"\n' + HEAD
    assert parse_plan(named + parts(1.0), Path(source)).name == "own"


def test_the_scenario_is_a_shipped_one_or_a_file_beside_the_plan(tmp_path):
    flat = load_scenario("flat", {"seed": 77})
    (tmp_path / "hall.toml").write_text(flat.toml())
    text = HEAD.replace("flat", "hall.toml") + parts(1.0)
    plan = parse_plan(text, tmp_path / "p.toml")
    assert (plan.scenario.seed, plan.scenario.robot) == (77, flat.robot)
    assert dict(plan.start) == dict(flat.gait.planes)
    listed = faults(text, "elsewhere/p.toml")
    assert list(listed) == ["scenario"]
    assert "a TOML file beside the plan, or one of " in listed["scenario"]
    assert list(faults('description = "d"\n' + parts(1.0))) == ["scenario"]
    assert list(faults(HEAD.replace("flat", "") + parts(1.0))) == ["scenario"]
    assert list(faults(HEAD.replace('"flat"', "3") + parts(1.0))) == ["scenario"]


def test_a_plane_comes_in_only_where_it_was_driven_from_the_start():
    two = "vertical = { amplitude = 0.1 }\nhorizontal = { lag = 0.7 }\n"
    head, rest = HEAD + "[gait]\nramp_s = 0.5\n", parts(1.0, 1.0, more=two)
    level = "[gait.{}]\namplitude = 0.2\nfrequency_hz = 0.5\nlag = 0.5\n"
    both = level.format("horizontal") + level.format("vertical")
    plan = parse_plan(head + both + rest, Path("p.toml"))
    for segment in plan.segments:
        assert [(plane.amplitude, plane.lag) for plane in segment.planes.values()] == [
            (0.2, 0.7), (0.1, 0.5),
        ]  # fmt: skip
    assert plan.ramp_s == 0.5
    lone = parts(1.0, more="vertical = { amplitude = 0.1 }\n")
    (segment,) = parse_plan(head + both + lone, Path("p.toml")).segments
    assert [plane.amplitude for plane in segment.planes.values()] == [0.2, 0.1]
    wrong = rest.replace("amplitude = 0.1", "amplitude = -0.1")
    assert list(faults(head + level.format("vertical") + wrong))[:2] == [
        "segments[0].horizontal", "segments[0].vertical.amplitude",
    ]  # fmt: skip
    missing = faults(head + level.format("horizontal") + rest)
    assert list(missing) == ["segments[0].vertical", "segments[1].vertical"]
    assert "driven from the start (horizontal)" in missing["segments[0].vertical"]
