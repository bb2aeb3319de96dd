"""The serpentine generator against Eqs. 2 and 6 in closed form."""

import math

import numpy as np
import pytest

from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, Serpentine, SerpentineGait, Wave
from undulog.sim.gait.wave import smoothstep, within_limits

NOTHING = Readings(np.empty(0), np.empty(0))


def run(gait, seconds, rate_hz=100):
    ticks = [gait.step(k / rate_hz, NOTHING) for k in range(round(seconds * rate_hz) + 1)]
    return np.array([t.command for t in ticks]), np.array([t.values for t in ticks]), ticks


def test_after_the_ramp_it_is_equation_2(make_robot):
    robot = make_robot()
    wave = PlaneGait(0.3, 0.5, math.pi / 6, offset=0.05)
    commands, _, _ = run(SerpentineGait(Serpentine({Plane.HORIZONTAL: wave}), robot), 6.0)
    t, i = np.arange(200, 601)[:, None] / 100, np.arange(13)
    expected = 0.3 * np.sin(2 * math.pi * 0.5 * t - i * math.pi / 6) + 0.05
    np.testing.assert_allclose(commands[200:, 0::2], expected, atol=1e-12)
    assert not commands[:, 1::2].any()  # the vertical plane is held


def test_the_vertical_plane_has_its_own_phase_as_in_equation_6(make_robot):
    robot = make_robot(14)
    planes = {
        Plane.HORIZONTAL: PlaneGait(0.4, 0.5, math.pi / 6),
        Plane.VERTICAL: PlaneGait(0.1, 0.75, 0.2, phase=math.pi / 2),
    }
    commands, _, _ = run(SerpentineGait(Serpentine(planes, ramp_s=0.0), robot), 3.0)
    t, i = np.arange(301)[:, None] / 100, np.arange(6)
    expected = 0.1 * np.sin(2 * math.pi * 0.75 * t - i * 0.2 + math.pi / 2)
    np.testing.assert_allclose(commands[:, 1::2], expected, atol=1e-12)


@pytest.mark.parametrize(("wave", "shift"), [(Wave.HEAD_TO_TAIL, 1), (Wave.TAIL_TO_HEAD, -1)])
def test_the_wave_runs_the_way_it_says(make_robot, wave, shift):
    # A quarter period later the shape has moved by one joint, since the lag is a quarter turn.
    gait = Serpentine({Plane.HORIZONTAL: PlaneGait(0.4, 0.5, math.pi / 2, wave)}, ramp_s=0.0)
    commands, values, _ = run(SerpentineGait(gait, make_robot()), 2.0)
    yaw = commands[:, 0::2]
    np.testing.assert_allclose(np.roll(yaw[17], shift)[1:-1], yaw[67][1:-1], atol=1e-12)
    assert values[0][2] == -shift * math.pi / 2  # the logged lag is signed


def test_the_logged_values_give_the_commands_back(make_robot):
    planes = {
        Plane.HORIZONTAL: PlaneGait(0.3, 0.8, 0.5, Wave.TAIL_TO_HEAD, offset=0.1, phase=0.4),
        Plane.VERTICAL: PlaneGait(0.2, 0.4, 0.7),
    }
    gait = SerpentineGait(Serpentine(planes), make_robot())
    commands, values, _ = run(gait, 3.0)
    parts = ("A", "omega", "lag", "offset", "phase")
    assert gait.names[:6] == (*(f"horizontal.{name}" for name in parts), "vertical.A")
    for start, columns in ((0, slice(0, None, 2)), (5, slice(1, None, 2))):
        A, _, lag, offset, phase = (values[:, start + k, None] for k in range(5))
        of_plane = commands[:, columns]
        expected = A * np.sin(phase + np.arange(of_plane.shape[1]) * lag) + offset
        np.testing.assert_allclose(of_plane, expected, atol=1e-14)


def test_the_start_is_smooth(make_robot):
    gait = Serpentine({Plane.HORIZONTAL: PlaneGait(0.4, 0.5, 1.0, offset=0.1)}, ramp_s=2.0)
    commands, values, _ = run(SerpentineGait(gait, make_robot()), 3.0, rate_hz=1000)
    assert not commands[0].any()
    rates = np.diff(commands, axis=0) * 1000
    assert np.abs(rates[0]).max() < 1e-3
    assert np.abs(np.diff(rates, axis=0) * 1000).max() < 10.0  # no jump of the rate anywhere
    np.testing.assert_allclose(values[2000:, 0], 0.4)


def test_the_phase_is_integrated_not_multiplied(make_robot):
    gait = SerpentineGait(Serpentine({Plane.HORIZONTAL: PlaneGait(0.4, 0.5, 1.0)}), make_robot())
    times = np.cumsum(np.random.default_rng(1).uniform(0, 0.05, 100))
    phases = [gait.step(t, NOTHING).values[4] for t in times]
    np.testing.assert_allclose(phases, math.pi * times, atol=1e-12)


def test_too_much_amplitude_is_cut_keeping_the_wave(make_robot):
    gait = Serpentine({Plane.HORIZONTAL: PlaneGait(0.5, 0.5, 1.0, offset=0.2)}, ramp_s=0.0)
    commands, values, ticks = run(SerpentineGait(gait, make_robot()), 2.0)
    assert values[0, 0] == pytest.approx(math.pi / 6 - 0.2)
    assert np.abs(commands).max() <= math.pi / 6
    assert ticks[0].clamped == ("horizontal.A",)


@pytest.mark.parametrize(
    ("wishes", "expected"),
    [
        ((0.3, 0.1), (0.3, 0.1)),
        ((0.5, 0.3), (0.2, 0.3)),
        ((0.5, -0.1), (0.1, -0.1)),
        ((0.3, 0.9), (0.0, 0.5)),
        ((0.3, -0.9), (0.0, -0.2)),
    ],
)
def test_limits_need_not_be_symmetric(wishes, expected):
    arrays = [np.array([value]) for value in (*wishes, -0.2, 0.5)]
    assert [value[0] for value in within_limits(*arrays)] == pytest.approx(expected)


def test_smoothstep():
    assert [smoothstep(x) for x in (-1, 0, 0.5, 1, 2)] == [0, 0, 0.5, 1, 1]
