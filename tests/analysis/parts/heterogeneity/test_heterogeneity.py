"""Indices of spread: no spread where there is none, the right one where there is."""

import numpy as np
import pytest

from undulog.analysis.estimators.intervals import welch_satterthwaite
from undulog.analysis.parts.heterogeneity.measure import (
    energy_indices,
    gini,
    response_indices,
    spread,
)
from undulog.analysis.response.response import Response
from undulog.analysis.session.runs import coupling_of_one_gait

BINS = 10


def measured(rng, gain, lag, noise):
    """One noisy measurement, its variances estimated from 2 L bins as real ones are."""
    count = gain.size
    noise = np.broadcast_to(noise, count)
    log_ratio = np.log(gain) + noise * rng.normal(size=count)
    log_ratio = log_ratio - 1j * (lag + noise * rng.normal(size=count))
    variance = noise**2 * rng.chisquare(2 * BINS, count) / (2 * BINS)
    return Response(np.exp(log_ratio), variance, variance, np.full(count, 2.0 * BINS))


def trials(gain, lag, noise, runs=150, seed=1):
    rng = np.random.default_rng(seed)
    return [response_indices(measured(rng, gain, lag, noise)) for _ in range(runs)]


def covers(draws, name, truth):
    low, high = np.transpose([indices[name].ci95 for indices in draws])
    return np.mean((low <= truth) & (truth <= high))


UNEQUAL = np.linspace(0.006, 0.014, 13)


def test_identical_joints():
    draws = trials(np.full(13, 0.95), np.full(13, 0.2), UNEQUAL)
    for name in ("common_response", "gain_cv", "lag_sd", "boundary_contrast_lag"):
        # 150 tests at 5 %: standard error 1.8 %.
        assert 0.005 < np.mean([indices[name].p < 0.05 for indices in draws]) < 0.105
    # Without the correction the CV would be 0.01 on average.
    assert np.mean([indices["gain_cv"].value for indices in draws]) < 0.004
    assert np.mean([indices["gain_cv"].ci95[0] == 0 for indices in draws]) > 0.95
    assert 0.9 < covers(draws, "boundary_contrast_gain", 0.0) < 0.99


@pytest.mark.parametrize("size", [0.01, 0.05])
def test_unlike_joints(size):
    rng = np.random.default_rng(2)
    gain = 0.95 * (1 + size * rng.normal(size=13))
    lag = 0.2 + size * rng.normal(size=13)
    draws = trials(gain, lag, UNEQUAL)
    # Noise is taken as equal over the joints: generous where the odd joint is a quiet one.
    assert covers(draws, "gain_cv", gain.std() / gain.mean()) > 0.91
    assert covers(draws, "lag_sd", lag.std()) > 0.91
    contrast = (lag[0] + lag[-1]) / 2 - lag[4:9].mean()
    assert 0.9 < covers(draws, "boundary_contrast_lag", contrast) < 0.99
    mean = np.mean([indices["gain_cv"].value for indices in draws])
    assert mean == pytest.approx(gain.std() / gain.mean(), rel=0.15)


def test_exact_measurements_give_exact_indices():
    gain, lag = np.linspace(0.9, 1.1, 7), np.linspace(0.1, 0.3, 7)
    exact = Response(gain * np.exp(-1j * lag), *np.full((2, 7), 1e-20), np.full(7, 8.0))
    indices = response_indices(exact)
    assert indices["gain_cv"].value == pytest.approx(gain.std() / gain.mean(), rel=1e-9)
    # For a small spread the circular standard deviation is the ordinary one.
    assert indices["lag_sd"].value == pytest.approx(lag.std(), rel=2e-3)
    assert indices["lag_sd"].ci95 == pytest.approx((lag.std(), lag.std()), rel=2e-3)
    assert indices["common_response"].p < 1e-12
    assert indices["boundary_contrast_lag"].value == pytest.approx(0.0, abs=1e-12)


def test_circular_sd_does_not_break_at_pi():
    lag = np.pi + np.array([-0.1, 0.0, 0.1, 0.05])
    here, there = (
        response_indices(Response(np.exp(-1j * phases), *np.full((2, 4), 1e-12), np.full(4, 8.0)))
        for phases in (lag, lag - 1)
    )
    assert here["lag_sd"].value == pytest.approx(there["lag_sd"].value, rel=1e-9)
    assert "boundary_contrast_lag" not in here  # four joints have no middle five


def test_equivalence_is_claimed_only_when_shown():
    alike, lag = np.full(13, 0.95), np.full(13, 0.2)
    precise = trials(alike, lag, 0.001, runs=50)
    assert all(indices["equivalence_gain"].p < 0.05 for indices in precise)
    assert all(indices["equivalence_lag"].p < 0.05 for indices in precise)
    noisy = trials(alike, lag, 0.02, runs=50)
    assert all(indices["equivalence_gain"].p > 0.05 for indices in noisy)
    unlike = alike.copy()
    unlike[6] *= 1.04
    assert all(i["equivalence_gain"].p > 0.5 for i in trials(unlike, lag, 0.001, runs=50))


def test_gini_and_cv_of_energies():
    assert gini(np.ones(8)) == pytest.approx(0.0)
    assert gini(np.array([0, 0, 0, 1.0])) == pytest.approx(3 / 4)
    values = np.random.default_rng(3).gamma(2.0, size=12)
    pairs = np.abs(values[:, None] - values[None, :]).mean() / (2 * values.mean())
    assert gini(values) == pytest.approx(pairs)
    cycles = np.outer(values, np.ones(6))
    indices = energy_indices(cycles)
    assert indices["energy_cv"].value == pytest.approx(values.std() / values.mean())
    assert indices["energy_gini"].ci95 == pytest.approx((gini(values), gini(values)))
    assert energy_indices(cycles[:, :2])["energy_cv"].ci95 is None
    assert energy_indices(cycles[:1]) == {}


def test_energy_intervals_cover():
    rng = np.random.default_rng(4)
    level = np.linspace(1.0, 2.0, 13)
    truth = level.std() / level.mean()
    draws = [energy_indices(level[:, None] * rng.normal(1, 0.05, (13, 8))) for _ in range(400)]
    assert 0.9 < covers(draws, "energy_cv", truth) < 0.99


def test_fewer_than_two_joints_have_no_spread():
    assert response_indices(Response(np.ones(1) + 0j, *np.ones((3, 1)))) == {}


def test_box_degrees_of_freedom():
    values = np.array([1.0, 2.0, 4.0])
    equal = spread(values, np.full(3, 0.5), np.full(3, 1e12))
    assert (equal.dof, equal.expected) == (pytest.approx(2.0), pytest.approx(1.0))
    # One joint far noisier than the others: one degree of freedom is left.
    assert spread(values, np.array([1.0, 1e-9, 1e-9]), np.full(3, 1e12)).dof == pytest.approx(1.0)


def test_welch_satterthwaite():
    variances, dof = np.array([[1.0], [1.0]]), np.array([[8.0], [8.0]])
    assert welch_satterthwaite(variances, dof)[0] == pytest.approx(16.0)
    assert welch_satterthwaite(variances * [[1], [0]], dof)[0] == pytest.approx(8.0)
    assert welch_satterthwaite(variances * 0, dof)[0] == 8.0


def test_one_gait_never_identifies_the_coupling():
    coupling = coupling_of_one_gait(13)
    assert (coupling.identifiable, coupling.matrix) == (False, None)
    assert coupling.why == "one gait gives 13 complex numbers for 169 unknown couplings"
    assert all(part in coupling.record for part in ("phase-kicks", "52 runs"))
    assert coupling_of_one_gait(1).identifiable is coupling_of_one_gait(0).identifiable is False
