"""Sessions whose commands are no gait: chosen systems, and recordings of real robots."""

import csv
import json
import zipfile

import numpy as np
import pytest
from scipy import signal, stats

from support.paths import SHARED, TRACE
from support.written_sessions import EPOCH_NS
from undulog.analysis import analyse_session
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.frequency_response.excitation import excited_bins, find_excitation
from undulog.analysis.parts.frequency_response.measure import estimate, frequency_responses
from undulog.analysis.parts.frequency_response.nonparametric import resampled, window
from undulog.analysis.signals.stretch import Options
from undulog.capture import Session, SessionWriter

STEP_S = 0.01
SERVO = signal.TransferFunction([1.0], [1 / 25.0**2, 2 * 0.5 / 25.0, 1.0])
DELAY_S = 0.03


def write(path, names, commands, states):
    """Analyse a session of commands and states, each with its times [s] and angles [rad]."""
    with SessionWriter(path, session_id="one", epoch_ns=EPOCH_NS) as writer:
        sent = writer.joint_state("/joint_commands", names, unit="rad")
        measured = writer.joint_state("/joint_states", names, unit="rad")
        for t, values in zip(*commands, strict=True):
            sent.write(EPOCH_NS + round(t * 1e9), values)
        for t, values in zip(*states, strict=True):
            measured.write(EPOCH_NS + round(t * 1e9), values)
        writer.set_verdict("good")
    with Session.open(path) as session:
        return analyse_session(session)


def responded(u, t):
    """The servo's response to a command, with a delay of whole steps."""
    y = signal.lsim(SERVO, u, t)[1]
    late = round(DELAY_S / STEP_S)
    return np.concatenate([np.zeros(late), y[:-late]])


@pytest.mark.parametrize(
    ("kind", "command"),
    [
        ("chirp", lambda t, rng: 0.3 * signal.chirp(t, 0.1, t[-1], 2.5)),
        ("steps", lambda t, rng: 0.2 * np.sign(rng.normal(size=t.size // 20)).repeat(20)),
        ("broadband", lambda t, rng: signal.lfilter([0.1], [1, -0.9], rng.normal(size=t.size))),
        ("sum of sines", lambda t, rng: sum(0.1 * np.sin(6.28 * f * t) for f in (0.31, 0.7, 1.9))),
    ],
)
def test_the_response_of_a_known_servo_lies_within_its_intervals(kind, command, tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 80.0, STEP_S)
    u = command(t, rng)
    y = responded(u, t) + 0.002 * rng.normal(size=t.size)
    result = write(tmp_path / "a.mcap", ["joint01"], (t, u[:, None]), (t, y[:, None]))
    (response,) = result.frequency_response
    assert response.excitation == kind
    f = np.array(response.frequency_hz)
    _, exact = signal.freqresp(SERVO, 2 * np.pi * f)
    exact = exact * np.sinc(f * STEP_S) ** 2  # a line from sample to sample, as lsim has it
    low, high = np.array(response.gain_ci95).T
    sure = np.array([interval is not None for interval in response.lag_ci95])  # others are noise
    assert sure.sum() >= 3
    assert np.mean(((low <= np.abs(exact)) & (np.abs(exact) <= high))[sure]) >= 0.85
    assert "frequency response" in result.answer.sentence
    assert json.loads(json.dumps(result.to_dict()))["frequency_response"][0]["joint"] == "joint01"
    if kind in ("steps", "broadband"):  # with power beyond the bandwidth
        assert response.bandwidth_hz == pytest.approx(25.0 * 1.27 / 2 / np.pi, rel=0.05)
    if kind != "sum of sines":  # three lines have no model
        assert response.delay_model is not None
        low, high = response.delay_s.ci95
        assert low <= DELAY_S <= high + 5e-4  # a twentieth of a sample: splines near their limit


needs_recordings = pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data")


def columns(path, key):
    with path.open() as stream:
        rows = list(csv.DictReader(stream))
    times = np.array([float(row["timestamp"]) * 1e-6 for row in rows])
    return times, np.array([json.loads(row[key]) for row in rows])


@pytest.mark.nightly
@needs_recordings
def test_the_halves_of_an_arms_multisine_agree(tmp_path):
    folder = SHARED / "so101/multisine"
    names = (folder / "joint_list.txt").read_text().split()
    commands, states = (
        columns(folder / "control.csv", "positions"),
        columns(folder / "state_motor.csv", "positions"),
    )
    result = write(tmp_path / "a.mcap", names, commands, states)
    responses = {response.joint: response for response in result.frequency_response}
    assert list(responses) == names
    agree, lines = np.sum([response.halves_agree for response in responses.values()], axis=0)
    assert lines == 24
    assert 22 <= agree <= 23, "91 to 98 %"
    assert responses["Rotation"].gain[0] == pytest.approx(1.0, abs=0.03)
    assert all(response.gain[0] > response.gain[-1] for response in responses.values())


def halves_of(command, response):
    """Return the responses of both halves of a record."""
    excitation = find_excitation(command)
    start, stop = command.t_s[0], command.t_s[-1]
    limits = (start, (start + stop) / 2), ((start + stop) / 2, stop)
    return [
        estimate(command.between(*limit), response.between(*limit), excitation) for limit in limits
    ]


@needs_recordings
def test_intervals_of_an_arms_multisine_are_as_wide_as_its_halves_differ():
    folder = SHARED / "so101/multisine"
    names = (folder / "joint_list.txt").read_text().split()
    recorded = [columns(folder / file, "positions") for file in ("control.csv", "state_motor.csv")]
    start = max(t[0] for t, _ in recorded)
    stop = min(t[-1] for t, _ in recorded)
    difference, half = [], []
    for k, name in enumerate(names):
        pair = [Series(name, *unrepeated(t - start, values[:, k])) for t, values in recorded]
        first, second = halves_of(*(series.between(0.0, stop - start) for series in pair))
        freedom = first.freedom + second.freedom
        quantile = stats.f.ppf(0.95, 2, 2 * freedom)
        difference.append(np.abs(first.value - second.value))
        half.append(np.sqrt((first.variance + second.variance) * quantile))
    # |d|^2 of a circular normal d is exponential: its 95 % quantile is log 20 / log 2 medians.
    implied = np.median(difference) * np.sqrt(np.log(20) / np.log(2))
    assert np.median(half) <= 1.5 * implied


def unrepeated(t, values):
    new = np.concatenate([[True], np.diff(t) > 0])
    return t[new], values[new]


def left_out(y, u, bins):
    """Predict each bin from the rest of its window, by plain least squares.

    Returns:
        Errors over their standard deviations, and the degrees of freedom of these.
    """
    half, errors = window(1, freedom=12), []
    for k in bins:
        index = np.arange(k - half, k + half + 1)
        powers = ((index - k) / half)[:, None] ** np.arange(3)
        design = np.hstack([u[index, None] / np.abs(u[index]).mean() * powers, powers])
        rest = index != k
        inverse = np.linalg.pinv(design[rest])
        coefficients = inverse @ y[index[rest]]
        freedom = rest.sum() - design.shape[1]
        noise = np.sum(np.abs(y[index[rest]] - design[rest] @ coefficients) ** 2) / freedom
        spread = 1 + np.linalg.norm(design[half] @ inverse) ** 2
        errors.append((y[k] - design[half] @ coefficients) / np.sqrt(noise * spread))
    return np.array(errors), freedom


def neighbours(errors):
    """Correlation of errors up to five bins apart."""
    power = np.mean(np.abs(errors) ** 2)
    return [np.mean((errors[:-k] * errors[k:].conj()).real) / power for k in range(1, 6)]


@needs_recordings
def test_each_bin_of_a_quadrupeds_chirp_is_predicted_by_the_others():
    """At the full resolution: even bins alone would fold both halves of the record together.

    Friction answers other parts of the chirp otherwise, so even bins (their sum) and odd ones
    (their difference) have other best linear responses: at the lowest bins each is smooth, and
    only the difference between them shows it.
    """
    with zipfile.ZipFile(SHARED / "go2/traj_0.pt") as archive:
        t, position, command = (
            np.frombuffer(archive.read(f"traj_0/data/{k}"), "<f4").astype(float) for k in (0, 1, 3)
        )
    rng = np.random.default_rng(0)
    inside, apart, expected = [], [], []
    for joint in range(12):
        pair = [
            Series("q", *unrepeated(t, values.reshape(-1, 12)[:, joint]))
            for values in (command, position)
        ]
        times = np.arange(t[0], t[-1], pair[0].period_s)
        asked, measured = (resampled(series, times) - series.values.mean() for series in pair)
        linear = signal.lsim(SERVO, asked, times)[1] + rng.normal(0, 0.005, times.size)
        u, y, truth = (np.fft.rfft(samples) for samples in (asked, measured, linear))
        bins = excited_bins(np.abs(u) ** 2)
        bins = bins[bins > window(1, freedom=12)]
        errors, freedom = left_out(y, u, bins)
        inside.extend(np.abs(errors) ** 2 <= stats.f.ppf(0.95, 2, 2 * freedom))
        apart.append(neighbours(errors))
        expected.append(neighbours(left_out(truth, u, bins)[0]))
    assert len(inside) > 500
    assert 0.91 <= np.mean(inside) <= 0.98
    # As white as of a linear servo; windows that overlap make each correlate with the next.
    white, scatter = np.mean(expected, axis=0), np.std(expected, axis=0)
    assert (np.abs(np.mean(apart, axis=0) - white) < 3 * scatter).all()


@pytest.mark.nightly
@needs_recordings
def test_a_quadrupeds_chirp_is_one_input(tmp_path):
    with zipfile.ZipFile(SHARED / "go2/traj_0.pt") as archive:
        t, position, command = (
            np.frombuffer(archive.read(f"traj_0/data/{k}"), "<f4").astype(float) for k in (0, 1, 3)
        )
    names = [
        f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")
    ]
    states, commands = position.reshape(-1, 12), command.reshape(-1, 12)
    result = write(tmp_path / "a.mcap", names, (t, commands), (t, states))
    assert len(result.frequency_response) == 12
    for response in result.frequency_response:
        assert response.excitation == "chirp"
        assert len(response.shares_command) == 11
        assert response.halves_agree is None
        assert response.distortion is None
    assert "All joints share one command" in result.answer.sentence


@needs_recordings
def test_a_servo_of_a_snake_follows_with_the_lag_of_its_ramp(tmp_path, command):
    session = tmp_path / "ramp.mcap"
    command("import", TRACE, "-o", session, "--robot", "arcsnake-joint")
    with Session.open(session) as opened:
        (response,) = analyse_session(opened, Options(start_s=3.0, stop_s=10.5)).frequency_response
    # Fitted in the time domain: position = 1.000 command(t - 7.4 ms) + offset.
    assert response.gain_ci95[0][0] <= 1.0 <= response.gain_ci95[0][1]
    assert response.delay_s.ci95[0] <= 7.4e-3 <= response.delay_s.ci95[1]


@pytest.mark.parametrize("planted", [0.0, 0.01])
def test_distortion_of_a_period_between_two_samples_is_that_which_was_planted(planted):
    """Odd lines are excited; one even line [rad] holds all that is nonlinear."""
    rng, period_s = np.random.default_rng(5), 7.8937
    t = np.arange(0.0, 5.4 * period_s, 0.02)
    lines, free = np.arange(1, 40, 2), np.arange(2, 40, 2)
    phase = 2 * np.pi * rng.random(lines.size)
    gain = 1 / (1 + 1j * lines / 15)
    turns = np.exp(2j * np.pi * np.outer(t, lines) / period_s + 1j * phase)
    u, y = 0.05 * turns.real.sum(axis=1), 0.05 * (turns @ gain).real
    y += planted * np.cos(2 * np.pi * 6 * t / period_s)
    (response,) = frequency_responses(
        {"a": Series("a", t, u)}, {"a": Series("a", t, y)}, pytest.fail
    )
    power = np.mean(0.05**2 * np.abs(gain) ** 2)
    truth = np.sqrt(planted**2 / free.size / power)
    assert response.excitation == "periodic multisine"
    assert response.distortion == pytest.approx(truth, rel=0.02, abs=2e-3)
