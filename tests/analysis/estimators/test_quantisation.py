"""Rounded channels: the step that is found, and intervals against planted truth."""

import estimator_tables
import numpy as np
import pytest
from scipy.special import stdtrit

from undulog.analysis.estimators.harmonic import fit_at
from undulog.analysis.estimators.intervals import response_errors
from undulog.analysis.estimators.quantisation import lattice_step
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import ResidualBins, residual_spectrum
from undulog.analysis.parts.comparison.profile import scatter_of

STEP = estimator_tables.STEP


def turn(amplitude, count=500, phase=0.3):
    return amplitude * np.sin(np.pi * np.arange(count) / 50 + phase)


@pytest.mark.parametrize("amplitude", [0.01, 0.5, 3.0])
def test_step_of_an_encoder(amplitude):
    rounded = STEP * np.rint(turn(amplitude) / STEP)
    assert lattice_step(rounded) == pytest.approx(STEP, rel=1e-9)
    assert lattice_step(0.1234 - rounded) == pytest.approx(STEP, rel=1e-9)
    assert lattice_step(np.degrees(rounded)) == pytest.approx(360 / 4096, rel=1e-9)
    single = rounded.astype(np.float32).astype(np.float64)
    assert lattice_step(single) == pytest.approx(STEP, rel=1e-6)
    assert lattice_step(np.cumsum(np.diff(rounded))) == pytest.approx(STEP, rel=1e-9)


def test_step_where_no_two_levels_are_neighbours():
    assert lattice_step(np.array([0, 6, 21, 31, 46, 6, 0]) * STEP) == pytest.approx(STEP)


@pytest.mark.parametrize("period", [4, 5, 6, 8, 12, 25, 100, 97.3])
@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_no_step_in_values_that_were_not_rounded(period, phase):
    assert lattice_step(0.5 * np.sin(2 * np.pi * np.arange(1000) / period + phase)) == 0


def test_no_step_in_few_levels():
    assert (lattice_step(np.ones(100)), lattice_step(np.zeros(0))) == (0, 0)
    assert lattice_step(np.sign(turn(1.0))) == 0


SLOW = [pytest.mark.slow, pytest.mark.built("tables")]

FEW = {"draws": 500}
"""The standard error of the coverage is 1 %."""


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("0.5 Hz at 50 Hz, any mean", FEW),
        ("0.5 Hz at 50 Hz, mean zero", FEW),
        ("the same, command rounded as well", FEW),
        ("the same, noise of 1 step", FEW),
        *(pytest.param(name, {"seed": 2}, marks=SLOW) for name in estimator_tables.ROUNDED),
    ],
)
def test_intervals_of_rounded_channels(name, options):
    covered, _, width = estimator_tables.rounded(**estimator_tables.ROUNDED[name], **options)
    assert np.all(covered > 0.91)
    assert np.all(width < 3)


def test_the_residual_alone_does_not_show_the_error():
    """Else the rounding again would not be needed."""
    assert np.all(estimator_tables.rounded(draws=100)[1] < 0.1)


def read_with_hysteresis(values, steps):
    """Round what a backlash of some steps leaves of values."""
    reading, held = np.empty(values.size), values[0]
    for k, value in enumerate(values):
        held = min(max(held, value - steps * STEP / 2), value + steps * STEP / 2)
        reading[k] = held
    return STEP * np.rint(reading / STEP)


STEP = 2 * np.pi / 4096


@pytest.mark.parametrize(("rate_hz", "frequency_hz"), [(50, 0.8), (200, 0.73)])
@pytest.mark.parametrize(("steps", "least", "most"), [(1, 0.9, 1), (0, 0, 0.05), (6, 0, 0.05)])
def test_an_interval_holds_a_lag_that_the_hysteresis_of_a_count_may_have_made(
    rate_hz, frequency_hz, steps, least, most
):
    """A backlash of h turns the fundamental by (2 / pi) h / A; one of many steps is the joint's."""
    random = np.random.default_rng(4)
    t, omega = np.arange(0, 20, 1 / rate_hz), 2 * np.pi * frequency_hz
    held = []
    for phase in random.uniform(0, 2 * np.pi, 20):
        wave = 0.25 * np.cos(omega * t + phase) + random.normal(0, 0.2 * STEP, t.size)
        series = [Series("q", t, read_with_hysteresis(wave, steps))]
        fit = fit_at(series, omega)
        noise, _ = residual_spectrum(series, fit)
        across = 1j * np.exp(1j * np.array([phase]))
        made = 2 / np.pi * max(steps, 1) * STEP
        held.append(1.96 * noise.along(across)[0] ** 0.5 > made)
    assert least <= np.mean(held) <= most


def test_noise_that_is_not_rounded_keeps_its_intervals():
    random = np.random.default_rng(3)
    series = [Series("q", np.arange(1000) / 50, turn(0.5, 1000) + random.normal(0, 1e-3, 1000))]
    noise, bins = residual_spectrum(series, fit_at(series, np.pi))
    assert not bins.rounding.any()
    assert noise.dof[0] == 24


def test_contrasts_of_rounded_joints():
    """Errors that joints share by rounding are counted as independent: never too narrow."""
    random = np.random.default_rng(4)
    t, joints, runs = np.arange(1000) / 50, 9, 60
    size = np.repeat(random.uniform(0.2, 0.8, runs), joints)
    phase = np.repeat(random.uniform(-3, 3, runs), joints) - np.tile(np.arange(joints), runs)
    truth = size * np.exp(1j * phase)
    waves = (truth[:, None] * np.exp(1j * np.pi * t)).real
    series = [Series("q", t, STEP * np.rint(wave / STEP)) for wave in waves]
    fit = fit_at(series, np.pi)
    _, bins = residual_spectrum(series, fit)
    exact = ResidualBins(0 * bins.values, bins.offset, bins.spread, 0 * bins.rounding)
    errors = response_errors(truth, exact, fit.fundamental, bins)
    deviation = np.log(fit.fundamental / truth).reshape(runs, joints)
    contrasts = np.eye(joints) - (1 - np.eye(joints)) / (joints - 1)
    inside = []
    for run in range(runs):
        errors_of_run = errors.select(range(run * joints, (run + 1) * joints))
        for scatter, value in zip(
            scatter_of(errors_of_run), (deviation[run].real, deviation[run].imag), strict=True
        ):
            half = stdtrit(scatter.columns.shape[1], 0.975) * scatter.variance(contrasts) ** 0.5
            inside.append(np.mean(np.abs(contrasts @ value) <= half))
    assert np.mean(inside) > 0.92
