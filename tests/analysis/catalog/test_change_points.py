"""Changes and outliers over sessions with memory, in drawn fleets whose truth is known."""

import math

import fleet_tables
import numpy as np
import pytest
from scipy.linalg import cholesky, inv

from undulog.analysis.catalog import change_points, session_noise
from undulog.analysis.catalog.change_points import DepartureKind, find_change_points
from undulog.analysis.catalog.session_noise import (
    SessionNoise,
    centred,
    estimate_noise,
    relative_to_others,
    scatter,
    simulate,
)


@pytest.fixture(autouse=True)
def few_simulations(monkeypatch):
    """Simulate a fifth of the fleets, which takes a fifth of the time."""
    monkeypatch.setattr(change_points, "_SIMULATIONS", 199)
    monkeypatch.setattr(session_noise, "_DRAWS", (50, 50))


def ar1(seed, n, m, rho):
    rng, case = np.random.default_rng(seed), fleet_tables.Case("", rho)
    return fleet_tables.noise(rng, (n, m), case)


def judged(values):
    nothing = np.zeros(len(values), np.int64)
    relative = relative_to_others(values, nothing)
    (quantity,) = find_change_points([relative], np.arange(len(values)) * 86_400.0, nothing)
    return quantity


def test_constant_and_short_series_have_no_change():
    times, nothing = np.arange(20.0), np.zeros(20, np.int64)
    constant = np.ones((20, 5))
    holes = np.random.default_rng(1).normal(size=(20, 5))
    holes[3] = np.nan
    results = find_change_points([constant, holes], times, nothing)
    assert [quantity.points for quantity in results] == [(), ()]
    assert results[0].noise is None
    (few,) = find_change_points([holes[:7]], times[:7], nothing[:7])
    (alone,) = find_change_points([holes], times, np.arange(20))
    for quantity in (few, alone):
        assert (quantity.noise, quantity.smallest) == (None, math.inf)


def test_of_three_joints_and_eight_sessions_little_is_decided():
    quantity = judged(0.01 * np.random.default_rng(0).normal(size=(8, 3)))
    assert quantity.points == ()
    assert 0.03 < quantity.smallest < 10  # with everything known 0.04


def test_one_joint_does_not_move_the_others():
    values = np.random.default_rng(2).normal(size=(40, 5)) * 0.01 + np.arange(5)
    moved = values.copy()
    moved[20:, 2] -= 3.0
    nothing = np.zeros(40, dtype=np.int64)
    before, after = (relative_to_others(levels, nothing) for levels in (values, moved))
    assert np.abs(after - before)[:, [0, 1, 3, 4]].max() < 0.03


def test_whitening_is_the_inverse_of_the_choleskian_factor_of_ar1_noise():
    sessions = np.array([0, 1, 3, 4, 8])
    covariance = 0.6 ** np.abs(sessions[:, None] - sessions[None, :])
    white = change_points._whitening(sessions, 0.6)
    np.testing.assert_allclose(white, inv(cholesky(covariance, lower=True)), atol=1e-12)


def test_simulated_fleets_have_the_memory_and_scatter_asked_for():
    noise = SessionNoise(0.5, 0.7, 0.0, 0.0, 0.01, np.where(np.arange(11) == 7, 2.0, 1.0))
    normal, nothing = np.random.default_rng(0).normal(size=(20, 300, 11)), np.zeros(300, np.int64)
    drawn = simulate(noise, 0.0, np.ones((300, 11), bool), nothing, normal)
    lags = [np.mean(drawn[:, k:] * drawn[:, : 300 - k]) for k in range(3)]
    np.testing.assert_allclose(np.array(lags[1:]) / lags[0], [0.7, 0.49], atol=0.04)
    spread = drawn.std(axis=(0, 1))
    assert spread[7] / np.median(spread) == pytest.approx(2.0, abs=0.15)


def test_scatter_is_that_of_the_noise_with_changes_and_outliers_in_it():
    values = 0.01 * ar1(3, 400, 9, 0.5)
    values[:, 4] *= 3
    values[200:, 2] += 0.2
    values[50, 3] += 1.0
    size = scatter(centred(values, np.zeros(400, np.int64)), 0.5, 0.003)
    np.testing.assert_allclose(size, [0.01] * 4 + [0.03] + [0.01] * 4, rtol=0.2)


def test_scatter_that_differs_by_chance_is_that_of_all_joints():
    size = scatter(0.01 * ar1(4, 20, 9, 0.0), 0.0, 0.06)
    np.testing.assert_allclose(size, size[0], rtol=0.05)


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_memory_is_without_bias_and_its_limit_holds(rho):
    nothing, rng = np.zeros(30, np.int64), np.random.default_rng(1)
    fleets = [relative_to_others(ar1(seed, 30, 6, rho), nothing) for seed in range(8)]
    noises = estimate_noise(fleets, nothing, rng)
    assert np.median([noise.rho for noise in noises]) == pytest.approx(rho, abs=0.15)
    assert sum(noise.upper >= rho for noise in noises) >= 5  # binomial, 90 %: 5 of 8 in 99.5 %


def test_quantities_with_different_memory_have_their_own():
    nothing, rng = np.zeros(60, np.int64), np.random.default_rng(3)
    series = [relative_to_others(ar1(8, 60, 8, rho), nothing) for rho in (0.0, 0.3, 0.9)]
    rhos = [noise.rho for noise in estimate_noise(series, nothing, rng)]
    assert rhos[0] < 0.15
    assert rhos[2] > 0.7
    alike = [relative_to_others(ar1(seed, 60, 8, 0.3), nothing) for seed in (1, 2, 3)]
    assert len({noise.rho for noise in estimate_noise(alike, nothing, rng)}) == 1


def test_two_changes_and_an_outlier_of_one_joint_are_found_by_themselves():
    values = 0.01 * ar1(5, 60, 6, 0.3)
    values[20:, 2] += 0.06
    values[42:, 2] -= 0.09
    values[8, 4] -= 0.15
    points = judged(values).points
    assert sorted((p.joint, p.kind, p.session) for p in points) == [
        (2, DepartureKind.STEP, 20),
        (2, DepartureKind.STEP, 42),
        (4, DepartureKind.OUTLIER, 8),
    ]
    for point, truth in zip(
        sorted(points, key=lambda p: p.session), (-0.15, 0.06, -0.09), strict=True
    ):
        low, high = point.change_ci95
        assert low <= truth <= high
        assert high - low < 0.06
        assert point.first <= point.session <= point.last
        assert point.p <= change_points.LEVEL


def test_a_joint_that_is_missing_in_some_sessions_is_dated_by_the_sessions_that_it_has():
    values = 0.01 * ar1(6, 40, 6, 0.3)
    values[25:, 1] += 0.1
    values[[3, 17, 18, 25, 31], 1] = np.nan
    (point,) = judged(values).points
    assert (point.joint, point.session) == (1, 26)


def test_the_smallest_step_is_found_and_half_of_it_not():
    values = 0.01 * ar1(7, 40, 6, 0.0)
    smallest = judged(values).smallest
    assert 0.01 < smallest < 0.03  # 4.5 to 6 of 0.01 (1 / 20 + 1 / 20)^0.5, and 1.3 more
    for factor, count in ((1.5, 1), (0.5, 0)):
        moved = values.copy()
        moved[20:, 3] += factor * smallest
        assert len(judged(moved).points) == count


def test_a_single_session_far_off_near_the_end_is_no_change():
    values = 0.01 * ar1(9, 40, 6, 0.0)
    values[38, 3] += 0.5
    (point,) = judged(values).points
    assert (point.joint, point.kind, point.session) == (3, DepartureKind.OUTLIER, 38)


def test_tails_of_the_noise_are_estimated():
    nothing, rng = np.zeros(60, np.int64), np.random.default_rng(2)
    for freedom, low, high in ((3.0, 0.15, 0.5), (None, 0.0, 0.12)):
        case = fleet_tables.Case("", 0.3, freedom=freedom)
        drawn = [fleet_tables.noise(rng, (60, 12), case) for _ in range(3)]
        noises = estimate_noise([relative_to_others(d, nothing) for d in drawn], nothing, rng)
        assert low <= noises[0].tail <= high
        assert noises[0].least_tail <= noises[0].tail


MOST = {50: 3, 400: 9}
"""Fleets to those of them that may have a claim: 99 % binomial limits of 1 %."""


@pytest.fixture
def all_simulations(monkeypatch):
    """Simulate as many as the product does."""
    monkeypatch.undo()


@pytest.mark.nightly
@pytest.mark.usefixtures("all_simulations")
def test_of_fifty_fleets_with_memory_and_without_changes_hardly_any_has_one():
    case = fleet_tables.Case("rho 0.6, 20 sessions", 0.6, sessions=(20, 20))
    assert fleet_tables.count(case, 50)["any"] <= MOST[50]


@pytest.mark.nightly
@pytest.mark.usefixtures("all_simulations")
@pytest.mark.parametrize("case", fleet_tables.NULLS, ids=lambda case: case.name)
def test_of_four_hundred_fleets_without_changes_few_have_one(case):
    assert fleet_tables.count(case, 400, 2)["any"] <= MOST[400]


@pytest.mark.nightly
@pytest.mark.usefixtures("all_simulations")
@pytest.mark.parametrize("case", fleet_tables.STEPS[:2], ids=lambda case: case.name)
def test_changes_are_found_with_date_and_size(case):
    of = fleet_tables.count(case, 100, 2)
    assert of["found"] >= 83  # binomial, 90 %: 83 or more in 99 %
    assert of["dated"] >= 0.87 * of["found"]
    assert of["sized"] >= 0.85 * of["found"]
    assert of["false"] <= 4
