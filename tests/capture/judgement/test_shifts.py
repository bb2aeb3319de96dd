"""Level shifts and drifts of a series against generalised least squares written out, and a null."""

import numpy as np
import pytest

from undulog.capture.judgement.shifts import (
    _fitted,
    _runs,
    correlation_of,
    drift_of,
    largest_shift,
    limited_weights,
    without_single,
)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("lasting", [True, False])
def test_each_run_is_fitted_as_by_the_inverse_covariance(rho, lasting):
    rng = np.random.default_rng(1)
    n = 12
    values, weights = rng.normal(size=n), rng.uniform(0.5, 2, n)
    every = np.arange(n)
    covariance = rho ** np.abs(every[:, None] - every) / np.sqrt(np.outer(weights, weights))
    inverse = np.linalg.inv(covariance)
    first, last = _runs(every, n, 2, lasting=lasting)
    change, outside, error = _fitted(values, weights, first, last, rho)
    for k in range(first.size):
        inside = (every >= first[k]) & (every < last[k])
        design = np.stack([np.ones(n), inside], axis=1)
        spread = np.linalg.inv(design.T @ inverse @ design)
        level, step = spread @ design.T @ inverse @ values
        left = values - design @ (level, step)
        variance = left @ inverse @ left / (n - 3) * spread[1, 1]
        np.testing.assert_allclose(
            [change[k], outside[k], error[k]], [step, level, variance**0.5], rtol=1e-9
        )


def drawn(rng, rho, joints=8, blocks=40):
    noise = rng.normal(size=(joints, blocks))
    for k in range(1, blocks):
        noise[:, k] = rho * noise[:, k - 1] + (1 - rho**2) ** 0.5 * noise[:, k]
    return noise


def found(values, weights):
    weights = limited_weights(without_single(values, weights))
    rho = correlation_of(values, weights)
    tests = 4 * len(values)
    pairs = zip(values, weights, strict=True)
    return [
        (largest_shift(v, w, rho, tests, 3, compared=True), drift_of(v, w, rho, tests))
        for v, w in pairs
    ]


@pytest.mark.parametrize("rho", [pytest.param(0.0, marks=pytest.mark.slow), 0.6])
def test_chance_alone_hardly_ever_makes_a_change(rho):
    rng = np.random.default_rng(7)
    wrong = 0
    for _ in range(150):
        values = drawn(rng, rho)
        wrong += any(any(pair) for pair in found(values, np.ones_like(values)))
    assert wrong <= 8  # 1 % of a quarter of the quantities; 99 % limit of 150 sessions at 2 %


def test_a_step_of_many_deviations_is_found_where_it_is():
    values = drawn(np.random.default_rng(3), 0.3)
    values[2, 25:] += 8
    shifts = [shift for shift, _ in found(values, np.ones_like(values))]
    assert [k for k, shift in enumerate(shifts) if shift] == [2]
    assert abs(shifts[2].first - 25) <= 1
    assert shifts[2].change == pytest.approx(8, abs=1)


def test_a_drift_is_found_with_its_size():
    values = drawn(np.random.default_rng(4), 0.0)
    values[5] += np.linspace(0, 12, values.shape[1])
    drifts = [drift for _, drift in found(values, np.ones_like(values))]
    assert drifts[5].change == pytest.approx(12, abs=2)


def test_one_block_alone_is_no_change_however_large():
    values = drawn(np.random.default_rng(5), 0.0)
    values[1, 20] = 1000
    assert not any(any(pair) for pair in found(values, np.ones_like(values)))


def test_blocks_in_which_a_response_settles_count_as_time():
    values = np.full(15, 0.01)
    values[:4] = 1.0
    # 17 blocks, of which the first two tell nothing: the change comes after six.
    values = np.concatenate([[0.0, 0.0], values + 1e-3 * np.sin(np.arange(15.0) ** 2)])
    weights = np.concatenate([[0.0, 0.0], np.ones(15)])
    shift = largest_shift(values, weights, 0.0, 4, 6, compared=True)
    assert shift is not None
    assert (shift.first, shift.last) == (0, 6)
