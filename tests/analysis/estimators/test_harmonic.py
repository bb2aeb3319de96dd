"""The harmonic fit against bounds, closed form and other people's least squares."""

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.signal import lfilter

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at, fit_shared
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series, clean
from undulog.analysis.estimators.spectrum import FundamentalNoise, omega_variance, residual_noise
from undulog.analysis.response.response import gain_estimate, lag_estimate, respond
from undulog.capture.common.errors import DataError


def coloured(rng, count, correlation):
    """AR(1) noise of unit variance."""
    white = rng.normal(size=count + 200)
    return lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white)[200:]


def part(noise, index):
    return FundamentalNoise(noise.level[index], noise.dof[index], noise.covariance[index])


class Trials:
    """Monte Carlo: 25 joints polled five at a time over 5 ms, known gain and lag."""

    def __init__(
        self,
        *,
        seed,
        frequency=0.97,
        duration=7.3,
        rate=100.0,
        runs=80,
        sigma=0.01,
        correlation=0.0,
        noisy_command=False,
    ):
        rng = np.random.default_rng(seed)
        m, n, amplitude, gain = 25, round(duration * rate), 0.5, 0.9
        omega = 2 * np.pi * frequency
        t = np.arange(n) / rate - duration / 2
        self.lag, self.gain, self.inside, self.gain_inside = [], [], [], []
        self.omega, self.omega_inside = [], []
        polled = [t + 5e-3 * k / 4 for k in range(5)]
        for _ in range(runs):
            lag = rng.uniform(0.05, 0.4, m)
            phase = rng.uniform(-3, 3) - np.arange(m) * np.pi / 3
            commands, responses = [], []
            for i in range(m):
                times = polled[i // 5]
                command = amplitude * np.sin(omega * t + phase[i])
                command += noisy_command * sigma * coloured(rng, n, correlation)
                response = gain * amplitude * np.sin(omega * times + phase[i] - lag[i])
                response += sigma * coloured(rng, n, correlation)
                commands.append(Series(f"c{i}", t, command))
                responses.append(Series(f"r{i}", times, response))
            channels = commands + responses
            fit = fit_shared(channels, omega + 2 * np.pi / duration * rng.uniform(-0.2, 0.2))
            noise = residual_noise(channels, fit)
            variance, dof = omega_variance(fit, noise)
            sides = [(fit.fundamental[k], part(noise, k)) for k in (np.s_[:m], np.s_[m:])]
            delay = fit.mean_time_s[m:] - fit.mean_time_s[:m]
            more = {"omega_variance": variance, "delay_between_s": delay}
            answer = respond(*sides[0], *sides[1], **more)
            for i in range(m):
                low, high = lag_estimate(answer, i).ci95
                self.lag.append(answer.lag_rad[i] - lag[i])
                self.inside.append(low <= lag[i] <= high)
                low, high = gain_estimate(answer, i).ci95
                self.gain.append(answer.gain[i] / gain - 1)
                self.gain_inside.append(low <= gain <= high)
            self.omega.append(fit.omega - omega)
            self.omega_inside.append(abs(fit.omega - omega) <= t_factor(dof) * variance**0.5)
        eta = np.array([amplitude**2 * noisy_command, (gain * amplitude) ** 2]) / (2 * sigma**2)
        self.bound = np.sqrt(np.sum(1 / (eta[eta > 0] * n)))
        self.omega_bound = rate * np.sqrt(12 / (n * (n**2 - 1) * m * eta.sum()))

    def ratio(self):
        return np.sqrt(np.mean(np.square(self.lag))) / self.bound


@pytest.mark.nightly
def test_lag_gain_and_intervals_with_exact_commands():
    trials = Trials(seed=11)
    # 2,000 lags: the ratio's own standard error is 1.6 %, the coverage's 0.5 %.
    assert 0.95 < trials.ratio() < 1.05
    assert 0.95 < np.sqrt(np.mean(np.square(trials.gain))) / trials.bound < 1.05
    assert 0.935 < np.mean(trials.inside) < 0.965
    assert 0.935 < np.mean(trials.gain_inside) < 0.965
    # 5 ms of polling would be 1.75 degrees if it were ignored.
    assert abs(np.degrees(np.mean(trials.lag))) < 0.01
    # An exact command gives the frequency exactly.
    assert np.max(np.abs(trials.omega)) < 1e-9
    assert all(trials.omega_inside)


@pytest.mark.nightly
def test_two_noisy_channels_and_the_shared_frequency():
    trials = Trials(seed=12, noisy_command=True)
    assert 0.95 < trials.ratio() < 1.05
    assert 0.935 < np.mean(trials.inside) < 0.965
    # 80 frequencies: the ratio's own standard error is 8 %.
    assert 0.8 < np.sqrt(np.mean(np.square(trials.omega))) / trials.omega_bound < 1.2
    assert np.mean(trials.omega_inside) > 0.88


@pytest.mark.nightly
@pytest.mark.parametrize("noisy_command", [False, True])
def test_intervals_hold_in_coloured_noise(noisy_command):
    trials = Trials(seed=13, correlation=0.9, noisy_command=noisy_command)
    # The white-noise bound is wrong by a factor of about four here ...
    assert 2.5 < trials.ratio() < 5
    # ... the intervals are not.
    assert 0.93 < np.mean(trials.inside) < 0.97
    assert 0.93 < np.mean(trials.gain_inside) < 0.97
    assert noisy_command is False or np.mean(trials.omega_inside) > 0.88


@pytest.mark.nightly
@pytest.mark.parametrize("correlation", [0.0, 0.9])
@pytest.mark.parametrize(
    ("frequency", "duration"), [(1.0, 3.1), (0.97, 4.2), (0.5, 8.0), (0.5, 8.9), (0.5, 30.0)]
)
def test_intervals_in_short_and_in_broken_cycles(frequency, duration, correlation):
    how = {"frequency": frequency, "duration": duration, "correlation": correlation}
    trials = Trials(seed=14, runs=100, **how)
    assert 0.93 < np.mean(trials.inside) < 0.97
    assert 0.93 < np.mean(trials.gain_inside) < 0.97


def test_one_channel_against_scipy_curve_fit():
    rng = np.random.default_rng(5)
    t = np.sort(rng.uniform(-4, 4, 400))  # uneven on purpose
    y = 0.3 + 0.4 * np.cos(5.1 * t + 0.7) + 0.06 * np.cos(10.2 * t - 1) + rng.normal(0, 0.03, 400)

    def model(t, omega, b, *parts):
        c1, s1, c2, s2 = parts
        phase, two = omega * t, 2 * omega * t
        return b + c1 * np.cos(phase) - s1 * np.sin(phase) + c2 * np.cos(two) - s2 * np.sin(two)

    theirs, covariance = curve_fit(model, t, y, p0=[5.0, 0, 0.4, 0, 0, 0], xtol=1e-14, ftol=1e-14)
    series = [Series("q", t, y)]
    fit = fit_shared(series, 5.0, HarmonicModel(harmonics=2))
    assert fit.omega == pytest.approx(theirs[0], abs=1e-8)
    ours = [fit.trend[0, 0], *np.ravel([(a.real, a.imag) for a in fit.amplitudes[0]])]
    np.testing.assert_allclose(ours, theirs[1:], atol=1e-7)
    # The frequency's standard error, theirs from the full Jacobian; ours with 24 bins of noise.
    variance, _ = omega_variance(fit, residual_noise(series, fit))
    assert variance**0.5 == pytest.approx(covariance[0, 0] ** 0.5, rel=0.4)


def test_fit_at_a_known_frequency_is_least_squares():
    rng = np.random.default_rng(6)
    t = np.linspace(0, 9, 500) + rng.uniform(-0.004, 0.004, 500)
    y = rng.normal(size=500) + 40.0
    columns = [np.ones_like(t), t, t**2]
    for h in (1, 2, 3):
        columns += [np.cos(h * 3.3 * t), -np.sin(h * 3.3 * t)]
    theirs, rss, *_ = np.linalg.lstsq(np.stack(columns, axis=1), y, rcond=None)
    fit = fit_at([Series("q", t, y)], 3.3, HarmonicModel(harmonics=3, trend=2))
    ours = [*fit.trend[0], *np.ravel([(a.real, a.imag) for a in fit.amplitudes[0]])]
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert fit.rss[0] == pytest.approx(rss[0], rel=1e-9)
    np.testing.assert_allclose(fit.predict(0, t), np.stack(columns, axis=1) @ theirs, atol=1e-9)


def test_the_last_step_takes_the_amplitudes_along():
    """Times far from zero, with a gap, so that amplitudes turn and change with omega."""
    rng = np.random.default_rng(8)
    t = 100 + np.sort(rng.uniform(0, 20, 3000))
    t = t[(t < 103) | (t > 109)]
    series = [
        Series(f"q{k}", t, np.cos(5 * t - k) + 0.3 * np.cos(10 * t) + rng.normal(0, 0.1, t.size))
        for k in range(3)
    ]
    model = HarmonicModel(harmonics=2, trend=1)
    best = fit_shared(series, 5.0, model)
    for off in (-3e-9, 3e-9):  # within the linear reach of the best
        near = fit_shared(series, best.omega + off, model)
        exact = fit_at(series, near.omega, model)
        assert near.omega == pytest.approx(best.omega, abs=1e-10)
        np.testing.assert_allclose(near.amplitudes, exact.amplitudes, rtol=0, atol=1e-12)
        np.testing.assert_allclose(near.trend, exact.trend, rtol=0, atol=1e-11)
        np.testing.assert_allclose(near.rss, exact.rss, rtol=1e-11)


def test_unix_nanoseconds_keep_their_resolution():
    epoch = 1_735_689_600_123_456_789
    t_ns = epoch + np.arange(1000) * 10_000_003
    y = np.cos(2 * np.pi * 0.8 * ((t_ns - epoch) * 1e-9) + 0.25)
    fit = fit_shared([clean("q", t_ns, y, epoch)], 2 * np.pi * 0.801)
    assert abs(fit.omega - 2 * np.pi * 0.8) < 1e-10
    assert abs(np.angle(fit.fundamental[0]) - 0.25) < 1e-9


def test_chunks_do_not_change_the_answer(monkeypatch):
    rng = np.random.default_rng(7)
    t = np.arange(3000) / 100
    series = [Series("q", t, np.cos(3 * t) + rng.normal(0, 0.1, 3000)) for _ in range(2)]
    whole = fit_shared(series, 3.01)
    level = residual_noise(series, whole).level
    monkeypatch.setattr("undulog.analysis.estimators.harmonic.CHUNK", 700)
    cut = fit_shared(series, 3.01)
    assert cut.omega == pytest.approx(whole.omega, abs=1e-12)
    np.testing.assert_allclose(residual_noise(series, cut).level, level, rtol=1e-9)


def test_gaps_leave_the_estimate_and_its_interval_fair():
    rng = np.random.default_rng(8)
    t = np.arange(1200) / 100
    t = t[(t < 3) | (t > 5.2)]
    inside = []
    for _ in range(400):
        y = 0.4 * np.cos(2 * np.pi * 0.6 * t - 0.3) + rng.normal(0, 0.02, t.size)
        series = [Series("q", t, y)]
        fit = fit_at(series, 2 * np.pi * 0.6)
        noise = residual_noise(series, fit)
        error = np.angle(fit.fundamental[0]) + 0.3
        across = 1j * fit.fundamental / np.abs(fit.fundamental)
        half = t_factor(noise.dof[0]) * noise.along(across)[0] ** 0.5 / np.abs(fit.fundamental[0])
        inside.append(abs(error) <= half)
    assert 0.92 < np.mean(inside) < 0.98


def test_too_few_samples_are_refused():
    with pytest.raises(DataError, match="q: 8 samples are too few to fit 7 parameters"):
        fit_at([Series("q", np.arange(8.0), np.arange(8.0))], 1.0)
    with pytest.raises(DataError, match="every channel is constant"):
        fit_shared([Series("q", np.arange(80.0), np.ones(80))], 1.0)
