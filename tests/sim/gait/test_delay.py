"""The delay-block generator against Eq. 2, and against its own closed form where they differ."""

import math

import numpy as np
import pytest

from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, Serpentine, SerpentineGait, Wave
from undulog.sim.gait.contract import Modulation
from undulog.sim.gait.delay_blocks import DelayBlockGait, DelayBlocks, DelayedPhase, DelayLine

NOTHING = Readings(np.empty(0), np.empty(0))
YAW = slice(0, 25, 2)
TAU = 1 / 6
OMEGA = math.pi


def build(robot, *, ramp_s=0.0, wave=Wave.HEAD_TO_TAIL, **fields):
    line = DelayLine(0.3, 0.5, TAU, wave, **fields)
    return DelayBlockGait(DelayBlocks({Plane.HORIZONTAL: line}, ramp_s), robot)


def faster(robot, factor):
    none = Modulation.none(len(robot.joints))
    return Modulation(none.amplitude_factor, none.offset, factor)


@pytest.mark.parametrize("wave", Wave)
def test_at_constant_omega_it_is_equation_2_with_the_lag_omega_tau(make_robot, wave):
    robot = make_robot()
    delayed = build(robot, wave=wave, offset=0.05, phase=0.4)
    # The master is the last joint where the wave comes from the tail: the phase is its own.
    first = 0.4 if wave is Wave.HEAD_TO_TAIL else 0.4 - 12 * OMEGA * TAU
    equal = PlaneGait(0.3, 0.5, OMEGA * TAU, wave, offset=0.05, phase=first)
    serpentine = SerpentineGait(Serpentine({Plane.HORIZONTAL: equal}, 0.0), robot)
    for k in range(601):
        tick, other = (gait.step(k / 100, NOTHING) for gait in (delayed, serpentine))
        if k >= 201:  # the longest delay is 2 s
            np.testing.assert_allclose(tick.command, other.command, atol=1e-13)
            np.testing.assert_allclose(tick.values[:4], other.values[:4], atol=1e-13)


def test_before_its_delay_is_over_a_joint_rests(make_robot):
    gait = build(make_robot(), phase=1.0, offset=0.1)
    for k in range(250):
        moved = gait.step(k / 100, NOTHING).command[YAW] != 0.0
        reached = k / 100 - TAU * np.arange(13)
        sure = np.abs(reached) > 1e-9
        np.testing.assert_array_equal(moved[sure], reached[sure] > 0.0)


def test_the_ramp_goes_down_the_line(make_robot):
    gait = build(make_robot(), ramp_s=1.0)
    amplitude = np.array([gait.step(k / 100, NOTHING).values for k in range(400)])[:, 5:18]
    x = np.clip(np.arange(400)[:, None] / 100 - TAU * np.arange(13), 0.0, 1.0)
    np.testing.assert_allclose(amplitude, 0.3 * (3 * x**2 - 2 * x**3), atol=1e-12)


def test_a_change_of_omega_arrives_late_where_equation_2_changes_at_once(make_robot):
    # omega doubles at t = 4: Phi(t') = pi t' before, pi (4 + 2 (t' - 4)) after, t' = t - (i-1) tau.
    robot = make_robot()
    wave = PlaneGait(0.3, 0.5, OMEGA * TAU)
    delayed = build(robot)
    serpentine = SerpentineGait(Serpentine({Plane.HORIZONTAL: wave}, 0.0), robot)
    differences = []
    for k in range(801):
        t = k / 100
        if k == 400:
            for gait in (delayed, serpentine):
                gait.modulate(faster(robot, 2.0))
        late, other = (gait.step(t, NOTHING).command[YAW] for gait in (delayed, serpentine))
        then = t - TAU * np.arange(13)
        phase = np.where(then < 4.0, OMEGA * then, OMEGA * (4.0 + 2.0 * (then - 4.0)))
        if k >= 201:
            np.testing.assert_allclose(late, 0.3 * np.sin(phase), atol=1e-12)
            differences.append(np.abs(late - other))
    differences = np.array(differences)
    assert differences[:200].max() < 1e-12  # equal until omega changes
    assert differences[:, 0].max() < 1e-12  # the master itself is Eq. 2 always
    # When the change has reached the whole body the lag is 2 pi / 6 and no more pi / 6.
    t = 8.0
    expected = 0.3 * np.sin(OMEGA * (2 * t - 4.0) - np.arange(13) * 2 * OMEGA * TAU)
    np.testing.assert_allclose(late, expected, atol=1e-12)
    assert differences[-1].max() > 0.2


def test_the_logged_lag_follows_omega(make_robot):
    robot = make_robot()
    gait = build(robot)
    assert gait.step(0.0, NOTHING).values[2] == pytest.approx(-OMEGA * TAU)
    gait.modulate(faster(robot, 2.0))
    assert gait.step(1.0, NOTHING).values[2] == pytest.approx(-2 * OMEGA * TAU)


def test_the_phase_is_remembered_exactly_however_long_it_runs():
    # Random rates at random times, one hour; the closed form is the sum of its pieces.
    random = np.random.default_rng(5)
    history = DelayedPhase(0.3, 1.0, span_s=2.0)
    times, omegas = [0.0], [1.0]
    for _ in range(20000):
        times.append(times[-1] + random.uniform(0.0, 0.02))
        omegas.append(random.uniform(-1.0, 5.0))
        history.advance(times[-1], omegas[-1])
    edges = np.array(times)
    sums = 0.3 + np.concatenate([[0.0], np.cumsum(np.diff(edges) * omegas[:-1])])
    asked = times[-1] - np.linspace(0.0, 2.0, 101)
    k = np.searchsorted(edges, asked, side="right") - 1
    exact = sums[k] + np.array(omegas)[k] * (asked - edges[k])
    np.testing.assert_allclose(history.at(asked), exact, atol=1e-9)


def test_a_controller_acts_at_the_joint_behind_its_delay(make_robot):
    gait = build(make_robot())
    factors, offsets = np.ones(25), np.zeros(25)
    factors[24], offsets[24] = 0.5, 0.1
    for k in range(300):
        before = gait.step(k / 100, NOTHING)
    gait.modulate(Modulation(factors, offsets))
    after = gait.step(2.99, NOTHING)  # no time has passed
    np.testing.assert_array_equal(after.command[:24], before.command[:24])
    assert after.command[24] == pytest.approx(0.5 * before.command[24] + 0.1, abs=1e-15)
