"""What a controller may do to any generator: nothing jumps in phase, no limit is passed."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undulog.capture import load_robot
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, Serpentine, Wave
from undulog.sim.gait.contract import Modulation
from undulog.sim.gait.delay_blocks import DelayBlocks, DelayLine
from undulog.sim.gait.oscillators import OscillatorChain, OscillatorChains, OscillatorKind
from undulog.sim.scenario.motion import generator

NOTHING = Readings(np.full(7, np.nan), np.full(7, np.nan))
STEP_S = 0.01


def snake(limits=((-math.pi / 6, math.pi / 6),) * 7):
    robot = load_robot("snake13")
    pairs = zip(robot.joints, limits, strict=False)
    joints = [dataclasses.replace(joint, lower=least, upper=most) for joint, (least, most) in pairs]
    return dataclasses.replace(robot, links=robot.links[:8], joints=tuple(joints))


def both(plane):
    return {Plane.HORIZONTAL: plane, Plane.VERTICAL: dataclasses.replace(plane, phase=1.0)}


GAITS = {
    "serpentine": Serpentine(both(PlaneGait(0.3, 0.5, 0.8, offset=0.05)), 0.5),
    "tail-to-head": Serpentine(both(PlaneGait(0.3, 0.5, 0.8, Wave.TAIL_TO_HEAD)), 0.0),
    "delay-blocks": DelayBlocks(both(DelayLine(0.3, 0.5, 0.2, offset=0.05)), 0.5),
    "phase": OscillatorChains(both(OscillatorChain(0.3, 0.5, 0.8, offset=0.05))),
    "hopf": OscillatorChains(
        both(OscillatorChain(0.3, 0.5, 0.8, oscillator=OscillatorKind.HOPF, start_phase=0.3))
    ),
}

seven = st.lists(st.floats(-1e3, 1e3), min_size=7, max_size=7).map(np.array)
modulations = st.builds(Modulation, seven, seven, st.floats(-10.0, 10.0))
some_limits = st.tuples(*[st.tuples(st.floats(-3.0, 0.0), st.floats(0.0, 3.0))] * 7)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", GAITS)
@given(some_limits, st.lists(modulations, min_size=1, max_size=8), st.integers(0, 9))
@settings(max_examples=40, deadline=None)
def test_no_modulation_passes_a_limit(kind, limits, changes, seed):
    robot = snake(limits)
    gait = generator(GAITS[kind], robot, per_joint=True)
    lower, upper = robot.limits()
    random = np.random.default_rng(seed)
    time_s = 0.0
    for change in changes:
        gait.modulate(change)
        for _ in range(4):
            tick = gait.step(time_s, NOTHING)
            assert np.all((tick.command >= lower) & (tick.command <= upper))
            time_s += random.uniform(0.0, 0.3)


@pytest.mark.parametrize("kind", GAITS)
@pytest.mark.parametrize("seed", range(3))
def test_what_jumps_is_amplitude_and_offset_never_the_phase(kind, seed):
    # |A' sin(p') + Y' - A sin(p) - Y| <= A |p' - p| + |A' - A| + |Y' - Y|, and p' - p = omega dt.
    robot = snake()
    gait = generator(GAITS[kind], robot, per_joint=True)
    random = np.random.default_rng(seed)
    pull = 0.0 if kind in ("serpentine", "delay-blocks", "tail-to-head") else 2 * 5.0 * 2.0
    ticks = []
    for k in range(600):
        factors, offsets = random.uniform(0.0, 1.5, 7), random.uniform(-0.2, 0.2, 7)
        gait.modulate(Modulation(factors, offsets, random.uniform(0.0, 3.0)))
        ticks.append(gait.step(k * STEP_S, NOTHING))
    values = np.array([tick.values for tick in ticks])
    amplitude, offset, phase = (
        values[:, [gait.names.index(f"{joint}.{key}") for joint in robot.joint_names]]
        for key in ("A", "offset", "phase")
    )
    command = np.array([tick.command for tick in ticks])
    np.testing.assert_allclose(command, amplitude * np.sin(phase) + offset, atol=1e-12)
    turn = np.abs(np.diff(phase, axis=0))
    assert turn.max() <= (3.0 * math.pi + pull) * STEP_S + 1e-9
    bound = np.abs(amplitude[1:]) * turn + np.abs(np.diff(amplitude, axis=0))
    bound += np.abs(np.diff(offset, axis=0))
    assert np.all(np.abs(np.diff(command, axis=0)) <= bound + 1e-12)


@pytest.mark.parametrize("kind", ["serpentine", "tail-to-head"])
def test_the_logged_omega_integrates_to_the_logged_phase(kind):
    gait = generator(GAITS[kind], snake())
    random = np.random.default_rng(2)
    times = np.cumsum(random.uniform(0.0, 0.03, 400))
    rows = []
    for time_s in times:
        factor = random.uniform(0, 3)
        gait.modulate(dataclasses.replace(Modulation.none(7), frequency_factor=factor))
        rows.append(gait.step(time_s, NOTHING).values)
    omega, phase = np.array(rows)[:, 1], np.array(rows)[:, 4]
    summed = phase[0] + np.cumsum(omega[:-1] * np.diff(times))
    np.testing.assert_allclose(phase[1:], summed, atol=1e-11)


def test_a_modulation_acts_on_its_own_joint_from_the_next_step_on():
    robot = snake()
    gait = generator(GAITS["tail-to-head"], robot, per_joint=True)
    plain = generator(GAITS["tail-to-head"], robot)
    gait.step(0.4, NOTHING)
    change = Modulation.none(7)
    factors, offsets = change.amplitude_factor.copy(), change.offset.copy()
    factors[2], offsets[5] = 0.5, 0.1
    gait.modulate(Modulation(factors, offsets))
    moved, still = (generator.step(0.4, NOTHING).command for generator in (gait, plain))
    np.testing.assert_allclose(moved, still * factors + offsets, atol=1e-15)


def test_where_all_joints_are_cut_the_plane_is_named_else_the_joints():
    gait = generator(GAITS["tail-to-head"], snake(), per_joint=True)
    gait.modulate(Modulation(np.full(7, 2.0), np.zeros(7)))
    assert gait.step(0.0, NOTHING).clamped == ("horizontal.A", "vertical.A")
    factors, offsets = np.ones(7), np.zeros(7)
    factors[3], offsets[4] = 2.0, 1.0
    gait.modulate(Modulation(factors, offsets))
    tick = gait.step(0.1, NOTHING)
    # An offset at the limit leaves no room for a wave.
    assert tick.clamped == ("joint05.A", "joint05.offset", "joint04.A")
    assert tick.command[4] == math.pi / 6


def test_unlike_limits_cut_each_joint_by_its_own_and_are_reported():
    limits = ((-0.1, 0.3), (-0.5, 0.5), (-0.5, 0.5), *(((-0.5, 0.5),) * 4))
    gait = generator(Serpentine({Plane.HORIZONTAL: PlaneGait(0.4, 0.5, 0.8)}, 0.0), snake(limits))
    tick = gait.step(0.0, NOTHING)
    values = dict(zip(gait.names, tick.values, strict=True))
    assert tick.clamped == ("joint01.A",)
    assert [values[f"joint0{i}.A"] for i in (1, 3, 5, 7)] == [0.1, 0.4, 0.4, 0.4]
    assert "joint02.A" not in values  # its plane is not driven


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (Modulation.none(6), "6 factors and 6 offsets; the robot has 7 joints"),
        (Modulation(np.ones(7), np.full(7, np.nan)), "NaN or infinity"),
        (Modulation(np.ones(7), np.zeros(7), math.inf), "NaN or infinity"),
    ],
)
def test_what_is_no_modulation_is_refused(change, match):
    with pytest.raises(UsageError, match=match):
        generator(GAITS["serpentine"], snake()).modulate(change)
