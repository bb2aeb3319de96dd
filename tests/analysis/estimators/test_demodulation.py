"""Gain and lag over time against planted truth: slow changes, a frequency that changes, noise."""

import itertools

import numpy as np
import pytest
from scipy.signal import lfilter

from support.written_topics import write_topics
from undulog.analysis.estimators.demodulation import (
    LoggedPhase,
    _difference_dof,
    amplitudes,
    cycles_of,
    demodulate,
)
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.over_time.measure import response_over_time
from undulog.analysis.signals.columns import read_columns
from undulog.capture import Session

T = np.arange(6000) / 100


def phase_of(omega):
    """The integral of a frequency over time, as a controller steps it."""
    return np.concatenate(([0.0], np.cumsum(omega[:-1] * 0.01)))


def wave(omega, gain, lag, amplitude, offset=0.0):
    phi = phase_of(omega)
    command = Series("q", T, amplitude * np.sin(phi - 0.4) + offset)
    return phi, command, gain * amplitude * np.sin(phi - 0.4 - lag) + 0.9 * offset


def cycles(phi, command, response, **options):
    phase = LoggedPhase(T, phi)
    edges = phase.edges_s()
    pair = demodulate(command, response, phase, edges)
    return cycles_of([edges], [pair[0]], [pair[1]], **options)


def middle(responses):
    return (responses.start_s + responses.stop_s) / 2


OMEGA = np.pi * (1 + 0.3 * np.sin(2 * np.pi * T / 23))
GAIN = 0.9 + 0.08 * np.sin(2 * np.pi * T / 31)
LAG = 0.25 + 0.15 * np.cos(2 * np.pi * T / 41)
AMPLITUDE = 0.3 + 0.06 * np.sin(2 * np.pi * T / 29)
OFFSET = 0.15 * np.sin(2 * np.pi * T / 17)


def test_a_steady_wave_is_estimated_to_rounding():
    same = np.ones(T.size)
    phi, command, response = wave(np.pi * same, 0.9 * same, 0.3 * same, 0.4 * same)
    responses = cycles(phi, command, Series("q", T, response))
    assert responses.ratio.size == 28  # of thirty cycles less a sample, half a one at either end
    np.testing.assert_allclose(responses.ratio, 0.9 * np.exp(-0.3j), atol=1e-9)


def test_slow_changes_of_everything_are_followed():
    """Frequency +-30 %, gain +-9 %, lag +-0.15 rad, amplitude and offset of the steering."""
    phi, command, response = wave(OMEGA, GAIN, LAG, AMPLITUDE, OFFSET)
    responses = cycles(phi, command, Series("q", T, response))
    at = middle(responses)
    gain, lag = np.interp(at, T, GAIN), np.interp(at, T, LAG)
    # A cycle's gain is its mean; in one cycle the truth changes by up to 0.03 and 2.6 degrees.
    np.testing.assert_allclose(np.abs(responses.ratio), gain, atol=0.007)
    np.testing.assert_allclose(-np.angle(responses.ratio), lag, atol=np.radians(0.4))
    turns = np.interp(responses.stop_s, T, phi) - np.interp(responses.start_s, T, phi)
    np.testing.assert_allclose(turns, 2 * np.pi, atol=1e-6)


def test_responses_on_their_own_times():
    phi, command, _ = wave(OMEGA, GAIN, LAG, AMPLITUDE)
    later_s = T + 0.004
    lagging = np.interp(later_s, T, phi) - 0.4 - np.interp(later_s, T, LAG)
    values = np.interp(later_s, T, GAIN * AMPLITUDE) * np.sin(lagging)
    responses = cycles(phi, command, Series("q", later_s, values))
    lag = np.interp(middle(responses), T, LAG)
    np.testing.assert_allclose(-np.angle(responses.ratio), lag, atol=np.radians(0.4))


@pytest.mark.nightly
@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_intervals_cover_in_white_and_coloured_noise(memory):
    """3,480 gains and lags, noise of 0.01 rad, white and AR(1), omega and amplitude changing."""
    rng = np.random.default_rng(5)
    same = np.ones(T.size)
    phi, command, response = wave(OMEGA, 0.9 * same, 0.3 * same, AMPLITUDE, OFFSET)
    exact = cycles(phi, command, Series("q", T, response)).ratio
    inside = []
    for _ in range(60):
        noise = lfilter([1], [1, -memory], rng.normal(0, 0.01 * (1 - memory**2) ** 0.5, T.size))
        responses = cycles(phi, command, Series("q", T, response + noise))
        half = t_factor(responses.dof) * responses.variance**0.5
        error = np.log(responses.ratio / exact)
        inside += [np.abs(error.real) < half, np.abs(error.imag) < half]
    assert 0.93 <= np.mean(inside) <= 0.97


def test_what_a_cycle_cannot_tell_is_missing():
    phi, command, response = wave(OMEGA, GAIN, LAG, AMPLITUDE)
    kept = (T < 20) | (T > 23)
    responses = cycles(phi, command, Series("q", T[kept], response[kept]))
    holed = (responses.stop_s > 20) & (responses.start_s < 23)
    # Also the neighbours, whose mean over a cycle around each sample reaches in.
    assert np.isnan(responses.ratio[holed]).all()
    assert np.isfinite(responses.ratio[(responses.stop_s < 18) | (responses.start_s > 25)]).all()
    still = Series("q", T, np.where(T < 30, 0.0, command.values))
    responses = cycles(phi, still, Series("q", T, response))
    assert np.isnan(responses.ratio[responses.stop_s < 28]).all()
    assert np.isfinite(responses.ratio[responses.start_s > 32]).all()


def test_a_phase_that_does_not_drive_the_command_gives_nothing():
    phi, _, response = wave(OMEGA, GAIN, LAG, AMPLITUDE)
    other = Series("q", T, 0.3 * np.sin(9.0 * T))
    assert np.isnan(cycles(phi, other, Series("q", T, response)).ratio).all()


def test_too_few_cycles_have_no_interval():
    phi, command, response = wave(OMEGA, GAIN, LAG, AMPLITUDE)
    phase = LoggedPhase(T[:800], phi[:800])
    edges = phase.edges_s()
    pair = demodulate(command, Series("q", T, response), phase, edges)
    responses = cycles_of([edges], [pair[0]], [pair[1]])
    assert np.isfinite(responses.ratio).all()
    assert np.isnan(responses.variance).all()
    assert responses.dof == 0


def over_time(path, phi):
    """What a session of two joints tells whose controller logged this phase."""
    turned = phase_of(OMEGA)[:, None] - np.array([0.0, 1.0])
    answer = 0.3 * GAIN[:, None] * np.sin(turned - LAG[:, None])
    gait = np.stack([np.full_like(phi, 0.3), OMEGA, phi], axis=1)
    topics = {
        "/joint_commands": (["j1", "j2"], "rad", 0.3 * np.sin(turned)),
        "/joint_states": (["j1", "j2"], "rad", answer),
        "/gait": (["plane.A", "plane.omega", "plane.phase"], "rad", gait),
    }
    write_topics(path, np.arange(T.size) * 10_000_000, topics, epoch_ns=0)
    with Session(path) as session:
        columns = read_columns(session, "/joint_commands", "/joint_states", lambda _: None)
        return response_over_time(session, columns, (), lambda _: None)


def test_a_phase_may_be_logged_within_a_turn(tmp_path):
    phi = phase_of(OMEGA)
    running = over_time(tmp_path / "running.mcap", phi)
    turning = over_time(tmp_path / "turning.mcap", phi % (2 * np.pi))
    assert len(running.joints[0].gain) == int((phi[-1] - 2 * np.pi) / (2 * np.pi))
    for joint, other in zip(running.joints, turning.joints, strict=True):
        assert joint.start_s == pytest.approx(other.start_s, abs=1e-9)
        assert joint.gain == pytest.approx(other.gain, rel=1e-9)
        assert joint.lag_rad == pytest.approx(other.lag_rad, abs=1e-9)


# -- the noise of a cycle, by second differences --------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 10, 200])
def test_second_differences_have_the_degrees_of_freedom_of_their_covariance(count):
    differences = np.zeros((count, count + 2))
    for k in range(count):
        differences[k, k : k + 3] = 1.0, -2.0, 1.0
    covariance = differences @ differences.T
    # Of a sum of squares (Satterthwaite), of two parts each.
    dof = 2 * np.trace(covariance) ** 2 / np.trace(covariance @ covariance)
    assert _difference_dof(count) == pytest.approx(dof)


def test_the_noise_of_a_cycle_is_that_of_its_second_differences():
    rng = np.random.default_rng(8)
    edges = [np.arange(42.0), np.arange(100.0, 131.0)]
    asked = [0.5 + 0.1 * np.cos(np.arange(edge.size - 1)) + 0j for edge in edges]
    truth = [0.8 * np.exp(-0.3j + 0.01j * np.arange(command.size)) for command in asked]
    sigma = 0.002
    given = [
        h * c + sigma * (rng.normal(size=c.size) + 1j * rng.normal(size=c.size))
        for h, c in zip(truth, asked, strict=True)
    ]
    responses = cycles_of(edges, asked, given)
    np.testing.assert_allclose(responses.ratio, np.concatenate(given) / np.concatenate(asked))
    expected = sigma**2 / np.abs(np.concatenate(given)) ** 2
    np.testing.assert_allclose(responses.variance, expected, rtol=0.5)
    assert responses.variance[3] / responses.variance[5] == pytest.approx(expected[3] / expected[5])
    by_hand = []
    for h, c in zip(given, asked, strict=True):
        ratio, share = h / c, 1 / np.abs(c) ** 2
        for k in range(1, c.size - 1):
            second = abs(ratio[k - 1] - 2 * ratio[k] + ratio[k + 1]) ** 2
            by_hand.append(second / (share[k - 1] + 4 * share[k] + share[k + 1]))
    power = np.abs(np.concatenate(given)) ** 2
    np.testing.assert_allclose(responses.variance, np.mean(by_hand) / 2 / power)
    assert responses.dof == pytest.approx(_difference_dof(len(by_hand)))
    np.testing.assert_array_equal(
        responses.start_s, np.r_[np.arange(41.0), np.arange(100.0, 130.0)]
    )
    np.testing.assert_array_equal(responses.stop_s, responses.start_s + 1.0)
    late = cycles_of(edges, asked, given, settled_s=50.0)
    np.testing.assert_allclose(late.variance, np.mean(by_hand[39:]) / 2 / power)
    # Too few are left: all count.
    np.testing.assert_allclose(
        cycles_of(edges, asked, given, settled_s=128.0).variance, responses.variance
    )


def test_whole_cycles_have_half_of_one_around_them():
    t = np.arange(1001) / 100
    phase = LoggedPhase(t, 0.3 + 2 * np.pi * 1.05 * t)
    edges = phase.edges_s()
    # 10.5 turns: nine whole cycles, and half of one at either end.
    np.testing.assert_allclose(edges, (np.pi + 2 * np.pi * np.arange(10)) / (2 * np.pi * 1.05))
    assert LoggedPhase(t[:100], 2 * np.pi * t[:100]).edges_s().size == 0
    assert LoggedPhase(t[:2], np.array([0.0, 1e9])).edges_s().size == 0
    np.testing.assert_allclose(
        phase.at(np.array([-1.0, 0.005, 11.0])), [np.nan, 0.3 + phase.value[1] / 2 - 0.15, np.nan]
    )


def test_the_amplitude_of_a_cycle_is_that_of_its_own_samples():
    rng = np.random.default_rng(9)
    t, omega = np.sort(rng.uniform(0.0, 4.0, 60)), 2 * np.pi
    starts = np.searchsorted(t, [0.0, 1.0, 1.2, 2.0, 4.0])
    values = rng.normal(size=(2, 3, t.size))
    measured = amplitudes(t, values, starts, omega)
    assert measured.shape == (2, 3, 4)
    for k, (i, j) in enumerate(itertools.pairwise(starts.tolist())):
        if j - i < 6:
            assert np.isnan(measured[..., k]).all()
            continue
        rows = np.stack([np.ones(j - i), np.cos(omega * t[i:j]), -np.sin(omega * t[i:j])], axis=1)
        best = np.linalg.lstsq(rows, values[..., i:j].reshape(6, -1).T, rcond=None)[0]
        np.testing.assert_allclose(measured[..., k].ravel(), best[1] + 1j * best[2], atol=1e-9)
    few = amplitudes(t, values, np.array([0, 3, 5]), omega)
    assert few.shape == (2, 3, 2)
    assert np.isnan(few).all()
    assert amplitudes(t, values, np.array([4]), omega).shape == (2, 3, 0)
