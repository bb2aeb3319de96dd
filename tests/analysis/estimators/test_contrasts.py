"""Contrasts between joints whose noise is shared: intervals against planted truth."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import stdtrit

from analysis.estimators.contrasts import contrast_variance, lag_contrast_variance, response_errors
from analysis.estimators.harmonic import HarmonicModel, fit_at
from analysis.estimators.series import Series
from analysis.estimators.spectrum import residual_noise, residual_spectrum
from analysis.response import respond

JOINTS, RATE, OMEGA = 9, 100.0, 2 * np.pi * 0.97
AMPLITUDE, GAIN, LAG = 0.5, 0.9, 0.3
FINE = 20


def contrasts():
    """Each joint against the mean of the others, ends against middle, linear trend."""
    each = np.eye(JOINTS) - (1 - np.eye(JOINTS)) / (JOINTS - 1)
    ends = np.full(JOINTS, -1 / (JOINTS - 2))
    ends[[0, -1]] = 0.5
    place = np.arange(JOINTS) - (JOINTS - 1) / 2
    return np.vstack([each, ends, place / (place @ place)])


def coloured(random, runs, count, correlation):
    """AR(1) noise of unit variance, (runs, count)."""
    white = random.normal(size=(runs, count + 200 * bool(correlation)))
    if not correlation:
        return white
    share = (1 - correlation**2) ** 0.5
    return lfilter([share], [1.0, -correlation], white)[:, 200:]


def simulated(shared, correlation, *, runs, apart_s=8e-4, duration_s=10.3, every=(1, 1, 1), seed=3):
    """Responses of identical joints, channels in the order joint, run; and their phases.

    Noise on a grid 20 times as fine as the samples, so that joints that are sampled at different
    times see the same course of it.
    """
    random = np.random.default_rng(seed)
    count = round(duration_s * RATE)
    fine = (np.arange((count + 2) * FINE) / FINE / RATE) - duration_s / 2
    smooth = correlation ** (1 / FINE)
    courses = [coloured(random, runs, fine.size, smooth) for _ in range(2)] if correlation else []
    ticks = random.normal(size=(2, runs, count))
    found = []
    phase = 0.4 - np.arange(JOINTS) * np.pi / 3
    for joint in range(JOINTS):
        steps = round(apart_s * joint * RATE * FINE)
        chosen = (np.arange(count) * FINE + steps)[:: every[joint % 3]]
        own = fine[chosen]
        # White noise is shared sample by sample: all joints of one tick have the same.
        first, second = (
            [one[:, chosen] for one in courses] if correlation else ticks[:, :, :: every[joint % 3]]
        )
        alone = coloured(random, runs, count, correlation)[:, :: every[joint % 3]]
        wave = OMEGA * own + phase[joint] - LAG
        size = GAIN * AMPLITUDE
        if shared == "nothing":
            values = size * np.cos(wave) + 0.01 * alone
        elif shared == "additive":
            values = size * np.cos(wave) + 0.01 * first + 0.003 * alone
        else:
            values = size * (1 + 0.02 * first) * np.cos(wave + 0.02 * second) + 0.003 * alone
        found += [Series("r", own, one) for one in values]
    return found, phase


def judged(shared, correlation, *, runs=300, **more):
    """Share of 95 % intervals of the contrasts that hold zero: of gain and of lag, each (11,)."""
    responses, phase = simulated(shared, correlation, runs=runs, **more)
    noise = residual_spectrum(responses, fit := fit_at(responses, OMEGA))
    t = responses[0].t_s
    commands = [Series("c", t, AMPLITUDE * np.cos(OMEGA * t + one)) for one in phase]
    asked = fit_at(commands, OMEGA)
    exact, exact_bins = residual_spectrum(commands, asked)
    weights, inside = contrasts(), []
    for run in range(runs):
        own = np.arange(JOINTS) * runs + run
        found = respond(
            asked.fundamental,
            exact,
            fit.fundamental[own],
            type(exact)(noise[0].level[own], noise[0].dof[own], noise[0].covariance[own]),
            bins=(exact_bins, noise[1].select(own)),
        )
        errors = found.errors
        gain, lag = weights @ np.log(found.gain), weights @ found.lag_rad
        of_gain, of_lag = contrast_variance(errors, weights), lag_contrast_variance(errors, weights)
        inside.append(
            [
                np.abs(value) <= stdtrit(dof, 0.975) * variance**0.5
                for value, (variance, dof) in ((gain, of_gain), (lag, of_lag))
            ]
        )
    return np.mean(inside, axis=0)


@pytest.mark.parametrize("shared", ["nothing", "additive", "modulation"])
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_contrasts_cover_whatever_joints_share(shared, correlation):
    """300 runs of nine joints: the standard error of one contrast's coverage is 1.3 %."""
    covered = judged(shared, correlation)
    assert 0.935 < covered[:, :JOINTS].mean() < 0.965
    assert 0.925 < covered[:, JOINTS:].mean() < 0.975  # four contrasts: 0.6 %


def test_joints_at_different_rates_and_short_records():
    for covered in judged("additive", 0.9, every=(1, 2, 3)):
        assert 0.93 < covered[:JOINTS].mean() < 0.97
    for covered in judged("additive", 0.9, duration_s=3.3):
        assert 0.92 < covered[:JOINTS].mean() < 0.98


@pytest.mark.slow
@pytest.mark.parametrize("shared", ["nothing", "additive", "modulation"])
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_coverage_of_contrasts(shared, correlation):
    """1,200 runs: the standard error of one contrast's coverage is 0.6 %."""
    covered = np.mean([judged(shared, correlation, seed=seed) for seed in range(10, 14)], axis=0)
    assert np.all((covered > 0.925) & (covered < 0.975))


def test_shared_noise_cancels_or_adds():
    """The same samples of noise on joints in phase, and on one half a turn apart."""
    random = np.random.default_rng(4)
    t = np.arange(1000) / RATE
    shared = random.normal(0, 0.01, t.size)
    series = [Series("r", t, np.cos(OMEGA * t + sign) + shared) for sign in (0.0, 0.0, np.pi)]
    fit = fit_at(series, OMEGA)
    noise, bins = residual_spectrum(series, fit)
    still = type(bins)(0 * bins.values, bins.offset, bins.spread, bins.rounding)
    errors = response_errors(fit.fundamental, still, fit.fundamental, bins)
    single = contrast_variance(errors, np.eye(3))[0]
    np.testing.assert_allclose(single, noise.level * bins.spread / 2, rtol=1e-3)
    assert contrast_variance(errors, np.array([1.0, -1.0, 0.0]))[0] < 1e-9 * single[0]
    # Half a turn apart: the noise that lifts the log gain of one lowers that of the other.
    apart, dof = contrast_variance(errors, np.array([1.0, 0.0, -1.0]))
    assert apart == pytest.approx(4 * single[0], rel=1e-2)
    assert dof == pytest.approx(24)


def test_level_and_bins_agree_and_short_channels_have_their_own_level():
    random = np.random.default_rng(5)
    t = np.arange(2000) / RATE
    long = [Series("q", t, np.cos(OMEGA * t) + random.normal(0, 0.1, t.size)) for _ in range(2)]
    short = Series("q", t[:900], np.cos(OMEGA * t[:900]) + random.normal(0, 0.1, 900))
    model = HarmonicModel()
    alone, bins = residual_spectrum(long, fit_at(long, OMEGA, model))
    np.testing.assert_allclose(np.mean(np.abs(bins.values) ** 2, axis=1), alone.level)
    np.testing.assert_allclose(bins.offset[:2], np.array([1, -1]) * 2 * np.pi / 20, rtol=1e-12)
    together = fit_at([*long, short], OMEGA, model)
    noise, common = residual_spectrum([*long, short], together)
    np.testing.assert_allclose(noise.level[:2], alone.level, rtol=1e-12)
    np.testing.assert_allclose(common.offset[0], 2 * np.pi / 9, rtol=1e-12)
    np.testing.assert_array_equal(residual_noise([*long, short], together).level, noise.level)
