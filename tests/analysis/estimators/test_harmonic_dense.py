"""The harmonic fit of several channels against dense least squares, column by column."""

import numpy as np
import pytest
from scipy import optimize

from undulog.analysis.estimators.harmonic import (
    HarmonicModel,
    _gauss_newton_step,
    basis,
    chunks,
    fit_at,
    fit_shared,
    solve,
    time_scale,
)
from undulog.analysis.estimators.series import Series
from undulog.capture.common.errors import DataError

MODEL = HarmonicModel(harmonics=3, trend=2, lines=(2.1, 4.7))
OMEGA = 3.2


def columns(t, omega=OMEGA, model=MODEL, scale=1.0):
    """The model's columns by their definition."""
    turns = [*model.lines, *(h * omega for h in range(1, model.harmonics + 1))]
    rows = [(t / scale) ** d for d in range(model.trend + 1)]
    for turn in turns:
        rows += [np.cos(turn * t), -np.sin(turn * t)]
    return np.stack(rows, axis=1)


def three_channels(noise=0.1):
    rng = np.random.default_rng(3)
    first, second = np.sort(rng.uniform(-3, 8, 150)), np.sort(rng.uniform(1, 9, 210))
    return [
        Series(
            f"q{k}",
            t,
            np.cos(OMEGA * t + k)
            + 0.4 * np.sin(2 * OMEGA * t - k)
            + 0.3 * np.cos(2.1 * t + 2 * k)
            + 0.2 * np.sin(4.7 * t)
            + 0.1 * t
            + 7.0
            + rng.normal(0, noise, t.size),
        )
        for k, t in enumerate((first, first, second))
    ]


def test_parameters_of_all_channels_are_those_of_dense_least_squares():
    series = three_channels()
    fit = fit_at(series, OMEGA, MODEL)
    assert (MODEL.first, MODEL.size) == (7, 13)
    for k, channel in enumerate(series):
        t, y = channel.t_s, channel.values
        scale = (t[-1] - t[0]) / 2
        x = columns(t)
        theta, (rss,), *_ = np.linalg.lstsq(x, y, rcond=None)
        np.testing.assert_allclose(fit.trend[k], theta[:3], rtol=1e-8)
        np.testing.assert_allclose(fit.lines[k], theta[3:7:2] + 1j * theta[4:7:2], rtol=1e-8)
        np.testing.assert_allclose(fit.amplitudes[k], theta[7::2] + 1j * theta[8::2], rtol=1e-8)
        assert fit.fundamental[k] == fit.amplitudes[k, 0]
        assert fit.rss[k] == pytest.approx(rss)
        assert fit.total[k] == pytest.approx(t.size * np.var(y))
        assert fit.explained[k] == pytest.approx(1 - rss / (t.size * np.var(y)))
        assert fit.weight[k] == pytest.approx((t.size - 13) / rss)
        assert (fit.count[k], fit.mean_time_s[k]) == (t.size, pytest.approx(t.mean()))
        scaled = columns(t, scale=scale)
        np.testing.assert_allclose(fit.inverse_gram[k], np.linalg.inv(scaled.T @ scaled), rtol=1e-6)
        expected = [*theta[:3] * scale ** np.arange(3), *theta[3:]]
        np.testing.assert_allclose(fit.parameters([k], scale)[0], expected, rtol=1e-8)
        # dy / d omega outside the span of the model.
        order = np.arange(1, 4)
        turned = 1j * order * fit.amplitudes[k] * np.exp(1j * np.outer(t, order) * OMEGA)
        slope = t * turned.sum(axis=1).real
        q = np.linalg.qr(x)[0]
        outside = slope - q @ (q.T @ slope)
        assert fit.information[k] == pytest.approx(outside @ outside, rel=1e-8)
    assert fit.frequency_hz == pytest.approx(OMEGA / 2 / np.pi)


def test_predictions_have_the_shape_of_their_times():
    series = three_channels()
    fit = fit_at(series, OMEGA, MODEL)
    t = np.linspace(-2.0, 3.0, 12).reshape(3, 4)
    several = fit.predict(np.array([2, 0]), t)
    assert several.shape == (2, 3, 4)
    for row, k in zip(several, (2, 0), strict=True):
        theta = np.linalg.lstsq(columns(series[k].t_s), series[k].values, rcond=None)[0]
        expected = (columns(t.ravel()) @ theta).reshape(3, 4)
        np.testing.assert_allclose(row, expected, rtol=1e-8)
        np.testing.assert_allclose(fit.predict(k, t), row, rtol=1e-12)


def profile(omega, series, model):
    """What the shared frequency makes least: logarithms of what each channel leaves."""
    total = 0.0
    for channel in series:
        q = np.linalg.qr(columns(channel.t_s, omega, model))[0]
        rest = channel.values - q @ (q.T @ channel.values)
        total += (channel.count - model.size) * np.log(rest @ rest)
    return total


@pytest.mark.parametrize("start", [3.12, 3.3])
def test_the_shared_frequency_is_that_of_maximum_likelihood(start):
    series = three_channels(0.3)
    fit = fit_shared(series, start, MODEL)
    best = optimize.minimize_scalar(
        profile, (3.15, 3.2, 3.25), args=(series, MODEL), options={"xtol": 1e-10}
    )
    assert fit.omega == pytest.approx(best.x, abs=3e-7)
    exact = fit_at(series, fit.omega, MODEL)
    np.testing.assert_allclose(fit.amplitudes, exact.amplitudes, atol=1e-12)
    np.testing.assert_allclose(fit.rss, exact.rss, rtol=1e-12)
    np.testing.assert_allclose(fit.lines, exact.lines, atol=1e-12)


def test_the_parameters_turn_with_the_frequency_as_derived():
    series = three_channels()[:2]
    near, far = (solve(series, OMEGA + off, MODEL) for off in (-1e-6, 1e-6))
    middle = solve(series, OMEGA, MODEL)
    scale = middle.moments.scale
    slope = (far.theta - near.theta) / 2e-6 / scale
    np.testing.assert_allclose(middle.drift, slope, rtol=1e-5, atol=1e-5)
    # The residual falls with the frequency as its projection tells.
    fall = (far.rss - near.rss) / 2e-6 / scale
    np.testing.assert_allclose(-2 * middle.projected, fall, rtol=1e-4)


def test_a_step_weighs_channels_by_their_noise():
    series = three_channels()
    parts = [([0, 1], solve(series[:2], OMEGA, MODEL)), ([2], solve(series[2:], OMEGA, MODEL))]
    above = below = 0.0
    for _, part in parts:
        scale = part.moments.scale
        above += np.sum(part.weight * part.projected) * scale
        below += np.sum(part.weight * part.squared) * scale**2
    assert _gauss_newton_step(parts) == pytest.approx(above / below)


def test_rows_of_the_basis_by_their_definition():
    model = HarmonicModel(harmonics=5, trend=3, lines=(0.7,))
    t = np.linspace(-1, 4, 30)
    rows = basis(t, 2.3, model, 2.0, spare=2)
    assert rows.shape == (model.size + 2, 30)
    np.testing.assert_allclose(rows[:-2].T, columns(t, 2.3, model, 2.0), atol=1e-12)
    assert time_scale(t) == 2.5
    assert time_scale(t[:1]) == 1.0


def test_records_are_cut_into_pieces():
    pieces = [(part.start, part.stop) for part in chunks(20_000)]
    assert pieces == [(0, 8192), (8192, 16_384), (16_384, 20_000)]
    assert [(part.start, part.stop) for part in chunks(8192)] == [(0, 8192)]
    assert list(chunks(0)) == []


def test_a_constant_channel_has_no_weight_and_nothing_explained():
    t = np.arange(9.0)
    fit = fit_at([Series("q", t, np.full(9, 2.0)), Series("q", t, np.cos(t))], 1.0)
    assert (fit.weight[0], fit.explained[0], fit.trend[0, 0]) == (0.0, 0.0, 2.0)
    assert fit.explained[1] == pytest.approx(1.0)
    # What is exact counts by its rounding: a tenth of a trillionth of its power.
    assert fit.weight[1] == pytest.approx(2 / (1e-13 * fit.total[1]), rel=1e-6)


def test_what_can_not_be_fitted_is_refused():
    with pytest.raises(DataError, match="nothing to fit: no channel has samples"):
        fit_at([], 1.0)
    t = np.arange(40.0)
    with pytest.raises(DataError, match="the harmonics cannot be separated"):
        fit_at([Series("q", t, np.cos(t))], 0.0)
    short = Series("q", t / 40, (t / 40) ** 3)
    with pytest.raises(DataError, match=r"the search from 0\.1 Hz left the positive frequencies"):
        fit_shared([short], 2 * np.pi * 0.1, HarmonicModel(harmonics=1))
