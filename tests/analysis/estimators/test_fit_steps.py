"""Steps of the shared frequency, one at a time, and fits of as few samples as there may be."""

import numpy as np
import pytest

from undulog.analysis.estimators import harmonic
from undulog.analysis.estimators.harmonic import (
    HarmonicFit,
    HarmonicModel,
    _gauss_newton_step,
    fit_at,
    fit_shared,
    solve,
)
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import omega_variance, residual_spectrum

OMEGA = 5.0
MODEL = HarmonicModel(harmonics=1)


def tone(count=400, span=20.0, seed=1):
    rng = np.random.default_rng(seed)
    t = 3.0 + np.linspace(0.0, span, count)
    return Series("q", t, np.cos(OMEGA * t + 0.4) + 0.01 * rng.normal(size=count))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_goes_a_quarter_of_a_bin_at_most(monkeypatch, sign):
    monkeypatch.setattr(harmonic, "MAX_STEPS", 1)
    # A shorter channel beside it: the longest record has the narrowest bins.
    series = [tone(), Series("p", *(part[:300] for part in (tone().t_s, tone().values)))]
    span = 20.0
    for bins, clipped in ((0.4, True), (0.2, False)):
        start = OMEGA - sign * bins * 2 * np.pi / span
        step = fit_shared(series, start, MODEL).omega - start
        expected = _gauss_newton_step(
            [([k], solve([channel], start, MODEL)) for k, channel in enumerate(series)]
        )
        assert sign * expected > 0
        assert (abs(expected) > np.pi / 2 / span) == clipped
        assert step == pytest.approx(sign * np.pi / 2 / span if clipped else expected, rel=1e-9)


def test_after_the_last_step_the_fit_is_that_of_its_frequency(monkeypatch):
    monkeypatch.setattr(harmonic, "MAX_STEPS", 2)
    series = [tone()]
    shared = fit_shared(series, OMEGA + 0.1, MODEL)
    exact = fit_at(series, shared.omega, MODEL)
    assert isinstance(shared, HarmonicFit)
    np.testing.assert_array_equal(shared.amplitudes, exact.amplitudes)
    np.testing.assert_array_equal(shared.rss, exact.rss)


def test_three_harmonics_and_a_constant_are_fitted_where_nothing_is_said():
    t = np.arange(200) / 20
    waves = [0.5 * np.cos(h * 2.0 * t + h) / h for h in (1, 2, 3)]
    series = [Series("q", t, 1.5 + sum(waves))]
    for fit in (fit_at(series, 2.0), fit_shared(series, 2.05)):
        assert fit.model == HarmonicModel(harmonics=3, trend=0, lines=())
        expected = [0.5 * np.exp(1j * h) / h for h in (1, 2, 3)]
        np.testing.assert_allclose(fit.amplitudes[0], expected, atol=1e-6)
        assert fit.trend[0] == pytest.approx([1.5])
        assert fit.explained[0] == pytest.approx(1.0)


@pytest.mark.parametrize("harmonics", [1, 2])
def test_two_samples_more_than_parameters_are_enough(harmonics):
    """The weight is the number of samples beyond the parameters over what is left."""
    model = HarmonicModel(harmonics=harmonics)
    rng = np.random.default_rng(4)
    t = np.arange(float(model.size + 2))
    series = Series("q", t, rng.normal(size=t.size))
    fit = fit_at([series], 1.1, model)
    rows = [t**0]
    for h in range(1, harmonics + 1):
        rows += [np.cos(1.1 * h * t), np.sin(1.1 * h * t)]
    rss = np.linalg.lstsq(np.stack(rows, axis=1), series.values, rcond=None)[1][0]
    assert fit.rss[0] == pytest.approx(rss)
    assert fit.weight[0] == pytest.approx(2 / rss)


def test_channels_of_different_lengths_share_their_frequency_by_what_they_tell():
    """Of n samples over a span T the frequency has a variance of 24 s^2 / (n a^2 T^2)."""
    sigma, spans, counts = 0.05, (20.0, 12.0), (900, 500)
    rng = np.random.default_rng(5)
    series = []
    for k, (span, count) in enumerate(zip(spans, counts, strict=True)):
        t = 100.0 + span * np.arange(count) / count
        series.append(Series(f"q{k}", t, np.cos(OMEGA * t) + sigma * rng.normal(size=count)))
    fit = fit_shared(series, OMEGA + 0.02, MODEL)
    noise, bins = residual_spectrum(series, fit)
    variance, dof = omega_variance(fit, noise)
    information = [n * T**2 / (24 * sigma**2) for n, T in zip(counts, spans, strict=True)]
    assert variance == pytest.approx(1 / sum(information), rel=0.5)
    assert abs(fit.omega - OMEGA) < 4 / sum(information) ** 0.5
    assert 12 <= dof <= 48
    np.testing.assert_allclose(noise.level, sigma**2, rtol=0.8)
    # What they share lies in the bins of the shorter one.
    assert bins.offset[0] == pytest.approx(2 * np.pi / 12.0)
    assert bins.values.shape == (2, bins.offset.size)
    assert bins.offset.tolist() == [k * s * bins.offset[0] for k in range(1, 7) for s in (1, -1)]
