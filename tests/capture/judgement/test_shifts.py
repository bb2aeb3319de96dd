"""Level shifts and drifts of a series against generalised least squares written out, and a null."""

import numpy as np
import pytest

from undulog.capture.judgement.shifts import (
    ShiftNoise,
    _fitted,
    _runs,
    common_noise,
    correlation_of,
    drift_of,
    largest_shift,
    limited_weights,
    noise_of,
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


def shifts_of(values, weights):
    weights = limited_weights(without_single(values, weights))
    rho = correlation_of(values, weights)
    tests = 4 * len(values)
    noises = [noise_of(v, w, rho) for v, w in zip(values, weights, strict=True)]
    pairs = []
    for k, (v, w) in enumerate(zip(values, weights, strict=True)):
        like = common_noise(noises[:k] + noises[k + 1 :], noises[k])
        shift = largest_shift(v, w, rho, tests, 3, compared=True, like=like)
        pairs.append((shift, drift_of(v, w, rho, tests)))
    return pairs


@pytest.mark.parametrize("rho", [pytest.param(0.0, marks=pytest.mark.slow), 0.6])
def test_chance_alone_hardly_ever_makes_a_change(rho):
    rng = np.random.default_rng(7)
    wrong = 0
    for _ in range(150):
        values = drawn(rng, rho)
        wrong += any(any(pair) for pair in shifts_of(values, np.ones_like(values)))
    assert wrong <= 8  # 1 % of a quarter of the quantities; 99 % limit of 150 sessions at 2 %


@pytest.mark.parametrize("scatter", [0.0, 0.5])
def test_chance_alone_makes_no_change_of_joints_of_which_each_has_a_noise_of_its_own(scatter):
    """Of few blocks: standard deviations of like joints scatter by a factor of exp(0.5)."""
    rng = np.random.default_rng(11)
    wrong = 0
    for _ in range(150):
        values = drawn(rng, 0.3, joints=6, blocks=14)
        values *= np.exp(scatter * rng.normal(size=(6, 1)))
        wrong += any(shift for shift, _ in shifts_of(values, np.ones_like(values)))
    assert wrong <= 5  # 0.5 % of a quarter of the quantities; 99 % limit of 150 sessions at 1 %


@pytest.mark.parametrize("step", [0.0, 1.5])
@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_the_noise_of_a_series_is_the_same_with_a_step(rho, step):
    """Of what is new from block to block: (1 - rho^2) times the weighted variance."""
    rng = np.random.default_rng(2)
    noises = []
    for _ in range(300):
        weights = rng.uniform(0.5, 2, 40)
        values = drawn(rng, rho, joints=1)[0] / np.sqrt(weights) + step * (np.arange(40) > 17)
        # Blocks without weight are none.
        noises.append(noise_of(np.append(values, 100.0), np.append(weights, 0.0), rho))
    variance = np.array([noise.variance for noise in noises])
    assert np.mean(variance) == pytest.approx(1 - rho**2, rel=0.05 if step == 0 else 0.2)
    freedom = 2 / np.var(variance / np.mean(variance))
    assert noises[0].freedom == pytest.approx(freedom, rel=0.25)


@pytest.mark.parametrize("freedom", [4, 12])
def test_the_noise_of_like_joints_is_known_as_well_as_they_agree(freedom):
    """Variances 3 d0 / chi2(d0) of 400 joints, each known with ten degrees of freedom."""
    rng = np.random.default_rng(5)
    variance = 3 * freedom / rng.chisquare(freedom, 400)
    like = common_noise([ShiftNoise(v * rng.chisquare(10) / 10, 10) for v in variance])
    assert 0.5 * freedom < like.freedom < 2 * freedom
    assert like.variance == pytest.approx(3, rel=0.15)


def test_joints_of_one_noise_are_one():
    rng = np.random.default_rng(6)
    like = common_noise([ShiftNoise(2 * rng.chisquare(10) / 10, 10) for _ in range(400)])
    assert like.freedom > 60
    assert like.variance == pytest.approx(2, rel=0.05)


def test_like_joints_tell_nothing_of_one_that_is_noisier_than_they():
    rng = np.random.default_rng(6)
    others = [ShiftNoise(2 * rng.chisquare(10) / 10, 10) for _ in range(20)]
    assert common_noise(others, ShiftNoise(4.0, 10)) == common_noise(others)
    assert common_noise(others, ShiftNoise(20.0, 10)) == ShiftNoise(0.0, 0.0)


def test_too_few_joints_tell_nothing_of_the_noise_of_another():
    assert common_noise([ShiftNoise(1.0, 10)] * 2) == ShiftNoise(0.0, 0.0)


def test_a_step_among_like_joints_is_found_in_few_blocks():
    """Alone it is within the limit of Student's distribution of eleven degrees of freedom."""
    values = drawn(np.random.default_rng(8), 0.0, joints=30, blocks=14)
    values[2, 8:] += 5.0
    weights = np.ones_like(values)
    assert [k for k, (shift, _) in enumerate(shifts_of(values, weights)) if shift] == [2]
    alone = largest_shift(values[2], weights[2], 0.0, 4 * 30, 3, compared=True)
    assert alone is None


def test_a_step_of_many_deviations_is_found_where_it_is():
    values = drawn(np.random.default_rng(3), 0.3)
    values[2, 25:] += 8
    shifts = [shift for shift, _ in shifts_of(values, np.ones_like(values))]
    assert [k for k, shift in enumerate(shifts) if shift] == [2]
    assert abs(shifts[2].first - 25) <= 1
    assert shifts[2].change == pytest.approx(8, abs=1)


def test_a_drift_is_found_with_its_size():
    values = drawn(np.random.default_rng(4), 0.0)
    values[5] += np.linspace(0, 12, values.shape[1])
    drifts = [drift for _, drift in shifts_of(values, np.ones_like(values))]
    assert drifts[5].change == pytest.approx(12, abs=2)


def test_one_block_alone_is_no_change_however_large():
    values = drawn(np.random.default_rng(5), 0.0)
    values[1, 20] = 1000
    assert not any(any(pair) for pair in shifts_of(values, np.ones_like(values)))


def test_blocks_in_which_a_response_settles_count_as_time():
    values = np.full(15, 0.01)
    values[:4] = 1.0
    # 17 blocks, of which the first two tell nothing: the change comes after six.
    values = np.concatenate([[0.0, 0.0], values + 1e-3 * np.sin(np.arange(15.0) ** 2)])
    weights = np.concatenate([[0.0, 0.0], np.ones(15)])
    shift = largest_shift(values, weights, 0.0, 4, 6, compared=True)
    assert shift is not None
    assert (shift.first, shift.last) == (0, 6)


@pytest.mark.parametrize("block", [0, -1])
def test_one_block_alone_at_an_end_is_left_out(block):
    values = drawn(np.random.default_rng(10), 0.0)
    values[1, block] = 1000
    weights = without_single(values, np.ones_like(values))
    assert weights[1, block] == 0
    values[1, [0, 1]] = 1000.0  # two are a change
    assert without_single(values, np.ones_like(values))[1, :2].all()
