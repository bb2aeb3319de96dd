"""Waves along chains whose motion is known in closed form, with white noise on every joint."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.oscillation import fit_motion, local_wave_numbers
from undulog.analysis.parts.free_motion.measure import free_motion
from undulog.analysis.response.fitting import fit_gait
from undulog.capture.robot.description import load_robot

OMEGA = 2 * np.pi * 0.83
NOISE = 0.01


def chain(amplitudes, seconds=12.0, rate=50.0, noise=0.0, seed=0):
    """Series of joints, each on its own irregular times, about the middle of the record."""
    random = np.random.default_rng(seed)
    channels = {}
    for k, amplitude in enumerate(amplitudes):
        t = np.arange(-seconds / 2, seconds / 2, 1 / rate) + random.uniform(0, 0.3 / rate)
        t = t + random.uniform(0, 0.3 / rate, t.size)
        values = np.real(amplitude * np.exp(1j * OMEGA * t)) + 0.1 * k
        name = f"joint{k + 1:02d}"
        channels[name] = Series(name, t, values + noise * random.standard_normal(t.size))
    return channels


def measured(series, robot=None):
    channel = next(iter(series.values()))
    gait = fit_gait({}, series, float(np.ptp(channel.t_s)), lambda _: None)
    return gait, free_motion(robot, fit_motion(series, gait))[0]


def semi_axes_ratio(amplitudes):
    """Feeny's index by the angle that turns real and imaginary part into the semi-axes."""
    turned = amplitudes * np.exp(-0.5j * np.angle(np.sum(amplitudes**2)))
    long, short = np.linalg.norm(turned.real), np.linalg.norm(turned.imag)
    return min(long, short) / max(long, short)


def test_a_wave_without_noise_is_found_exactly():
    amplitudes = 0.4 * np.exp(-0.7j * np.arange(8))
    _, motion = measured(chain(amplitudes))
    (wave,) = motion.waves
    assert wave.wave_number.value == pytest.approx(0.7, abs=1e-9)
    assert wave.waves.value == pytest.approx(7 * 0.7 / (2 * np.pi), abs=1e-9)
    assert wave.speed.value == pytest.approx(OMEGA / 0.7, rel=1e-9)
    assert wave.direction == "first-to-last"
    assert wave.deviation_rad == pytest.approx(0.0, abs=1e-9)
    assert [joint.amplitude_rad.value for joint in motion.joints] == pytest.approx([0.4] * 8)
    assert [joint.offset_rad.value for joint in motion.joints] == pytest.approx(0.1 * np.arange(8))
    assert [joint.lag_rad.value for joint in motion.joints[1:]] == pytest.approx([0.7] * 7)
    assert motion.joints[0].lag_rad.value is None


def test_a_robot_gives_planes_and_metres():
    robot = load_robot("snake25")
    step = {name: (0.5 if k % 2 else -0.4) for k, name in enumerate(robot.joint_names)}
    place = {name: k // 2 for k, name in enumerate(robot.joint_names)}
    series = chain([0.3 * np.exp(-1j * step[name] * place[name]) for name in robot.joint_names])
    _, motion = measured(series, robot)
    first, second = motion.waves
    length = robot.links[1].length + robot.links[2].length
    assert first.wave_number.value == pytest.approx(-0.4)
    assert second.wave_number.value == pytest.approx(0.5)
    assert first.direction == "last-to-first"
    assert first.speed_m_s.value == pytest.approx(OMEGA / 0.4 * length)
    assert {wave.plane for wave in motion.waves} == {joint.plane for joint in motion.joints}


@pytest.mark.nightly
@settings(max_examples=40, deadline=None)
@given(
    st.floats(-3.0, 3.0),
    st.lists(st.floats(0.05, 1.0), min_size=3, max_size=9),
    st.floats(-np.pi, np.pi),
)
def test_order_and_time_turn_a_wave_round(step, sizes, phase):
    """From the other end it runs the other way, and its index is that of the semi-axes."""
    amplitudes = np.array(sizes) * np.exp(1j * (phase - step * np.arange(len(sizes))))
    series = chain(amplitudes)
    (wave,) = measured(series)[1].waves
    back = dict(reversed(series.items()))
    (reverse,) = measured(back)[1].waves
    assert wave.wave_number.value == pytest.approx(step, abs=1e-6)
    assert reverse.wave_number.value == pytest.approx(-step, abs=1e-6)
    index = pytest.approx(semi_axes_ratio(amplitudes), abs=1e-6)
    assert wave.travelling_index.value == index
    assert reverse.travelling_index.value == index


@pytest.mark.nightly
def test_a_standing_wave_has_no_direction_and_an_interval_to_zero():
    random = np.random.default_rng(1)
    to_zero = 0
    for seed in range(40):
        sizes = 0.3 * np.cos(0.4 * np.arange(6) + random.uniform(0, 3))
        (wave,) = measured(chain(sizes + 0j, noise=NOISE, seed=seed))[1].waves
        to_zero += wave.travelling_index.ci95[0] == 0.0
        assert wave.travelling_index.value < 0.05
        assert wave.standing is (wave.travelling_index.ci95[0] == 0.0)
        assert wave.direction == "undecided" or not wave.standing
    assert to_zero >= 34  # 95 % of 40 within binomial scatter


def test_a_standing_wave_has_no_direction():
    """0.6 rad from joint to joint: noise alone would draw one."""
    sizes = 0.4 * np.cos(0.6 * np.arange(10) + 1.0)
    (wave,) = measured(chain(sizes + 0j, seconds=20.0, noise=0.003))[1].waves
    assert wave.standing
    assert wave.direction == "undecided"


def test_a_wave_number_holds_how_far_phases_are_off_a_line():
    """A wavelength that shortens along the body: each half's own slope is in the interval."""
    steps = np.linspace(0.4, 0.9, 9)
    amplitudes = 0.3 * np.exp(-1j * np.concatenate(([0.0], np.cumsum(steps))))
    (wave,) = measured(chain(amplitudes, noise=NOISE))[1].waves
    low, high = wave.wave_number.ci95
    assert wave.wave_number.value == pytest.approx(steps.mean(), abs=0.02)
    assert high - low > 0.1
    (straight,) = measured(chain(0.3 * np.exp(-0.65j * np.arange(10)), noise=NOISE))[1].waves
    low, high = straight.wave_number.ci95
    assert high - low < 0.01
    assert wave.direction == straight.direction == "first-to-last"


def test_a_wave_that_is_no_even_one_has_wave_numbers_along_the_body():
    """The steps from joint to joint are known."""
    truth = np.linspace(0.3, 1.1, 9)
    amplitudes = 0.3 * np.exp(-1j * np.concatenate(([0.0], np.cumsum(truth))))
    names, held = [f"joint{k:02d}" for k in range(1, 11)], 0
    for seed in range(20):
        (wave,) = measured(chain(amplitudes, noise=NOISE, seed=seed))[1].waves
        assert [(part.joint, part.next_joint) for part in wave.local] == [*pairwise(names)]
        ends = [part.wave_number.ci95 for part in wave.local]
        held += sum(low <= step <= high for (low, high), step in zip(ends, truth, strict=True))
    assert held >= 0.90 * 180  # neighbours share a joint: less than 180 independent ones
    for even in (0.3 * np.exp(-0.65j * np.arange(10)), 0.4 * np.cos(0.6 * np.arange(10) + 1) + 0j):
        (wave,) = measured(chain(even, noise=NOISE))[1].waves
        assert wave.local == ()


def test_the_place_of_a_joint_that_is_left_out_counts():
    steps = np.array([0.3, 0.5, 1.2, 0.7])
    phases = -np.concatenate(([0.0], np.cumsum(steps)))
    series = chain(0.3 * np.exp(1j * phases), noise=NOISE)
    motion = fit_motion(series, measured(series)[0]).oscillation
    index = np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    numbers = local_wave_numbers(motion, index, phases)
    assert [number.value for number in numbers] == pytest.approx([0.3, 0.5, 0.6, 0.7])


def test_a_joint_at_rest_has_no_phase_and_the_wave_goes_on_behind_it():
    amplitudes = 0.4 * np.exp(-0.7j * np.arange(8))
    amplitudes[3] = 0.0
    series = chain(amplitudes, noise=NOISE)
    gait = fit_gait({}, series, 12.0, lambda _: None)
    motion, lost = free_motion(None, fit_motion(series, gait))
    assert lost == ("joint04",)
    assert "joint04" not in motion.waves[0].joints
    assert motion.waves[0].wave_number.value == pytest.approx(0.7, abs=0.01)
    assert motion.joints[4].lag_rad.value == pytest.approx(1.4, abs=0.02)


def test_a_constant_joint_keeps_its_place_in_the_chain():
    series = chain(0.4 * np.exp(-0.7j * np.arange(8)), noise=NOISE)
    dead = series["joint04"]
    series["joint04"] = Series("joint04", dead.t_s, np.full_like(dead.values, 0.2))
    _, motion = measured(series)
    assert motion.waves[0].wave_number.value == pytest.approx(0.7, abs=0.01)


@pytest.mark.nightly
@pytest.mark.parametrize("seconds", [8.0, 20.0, 60.0])
def test_intervals_hold_the_truth_and_are_no_wider_than_the_bound(seconds):
    """95 % of 200 draws within binomial scatter (91 to 98 %), width over the Cramer-Rao bound's."""
    steps = np.full(5, 0.76)  # a straight line: what is off it has a test of its own
    sizes = np.array([0.2, 0.25, 0.3, 0.25, 0.3, 0.4])
    amplitudes = sizes * np.exp(-1j * np.concatenate(([0.0], np.cumsum(steps))))
    truth = measured(chain(amplitudes, seconds))[1]
    slope = truth.waves[0].wave_number.value
    index = semi_axes_ratio(amplitudes)
    held, widths = np.zeros((200, 5), bool), np.zeros((200, 4))
    for seed in range(200):
        gait, motion = measured(chain(amplitudes, seconds, noise=NOISE, seed=seed))
        wave, joint = motion.waves[0], motion.joints[3]
        half = t_factor(gait.omega_dof) * gait.omega_error
        widths[seed, 0] = 2 * half
        for k, (ends, value) in enumerate(
            (
                (joint.lag_rad.ci95, steps[2]),
                (wave.wave_number.ci95, slope),
                (joint.amplitude_rad.ci95, sizes[3]),
                (wave.travelling_index.ci95, index),
            ),
            start=1,
        ):
            held[seed, k] = ends[0] <= value <= ends[1]
            if k < 4:
                widths[seed, k] = ends[1] - ends[0]
        held[seed, 0] = abs(gait.fit.omega - OMEGA) <= half
    count = seconds * 50.0
    of_phase = 2 * NOISE**2 / (count * sizes**2)  # Rife and Boorstyn 1974
    weight = 1 / of_phase
    place = np.arange(6) - np.average(np.arange(6), weights=weight)
    bounds = np.sqrt(
        [
            12 / (seconds**2 * weight.sum()),
            of_phase[2] + of_phase[3],
            1 / (weight @ place**2),
            2 * NOISE**2 / count,
        ]
    )
    assert ((held.mean(axis=0) >= 0.91) & (held.mean(axis=0) <= 0.985)).all(), held.mean(axis=0)
    ratio = np.median(widths, axis=0) / (2 * 1.96 * bounds)
    assert (ratio < 1.1).all(), ratio
