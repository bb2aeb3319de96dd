"""Pooling runs of one direction: the mean's variance against draws with a known scatter."""

import numpy as np
import pytest

from undulog.analysis.experiment.pooling import pool_runs
from undulog.analysis.response.response import Response, gain_estimate, lag_estimate
from undulog.capture.common.errors import UsageError

LN_H = np.array([0.0, -0.1 - 0.2j, 0.05 - 3.1j, -0.3 + 0.1j])


def drawn(rng, runs, between, within, ln_h=LN_H):
    """Responses with the scatter of runs and the noise within them; the noise is known."""
    made = []
    for _ in range(runs):
        z = rng.normal(0.0, np.hypot(between, within), (2, ln_h.size))
        variance = np.full(ln_h.size, within**2)
        dof = np.full(ln_h.size, 40.0)
        made.append(Response(np.exp(ln_h + z[0] + 1j * z[1]), variance, variance, dof))
    return made


@pytest.mark.parametrize("runs", [2, 3, 6])
@pytest.mark.parametrize("between", [0.0, 0.003, 0.03])
def test_intervals_of_the_mean_hold(runs, between):
    rng = np.random.default_rng(1)
    held = total = 0
    for _ in range(250):
        pooled = pool_runs("abcd", drawn(rng, runs, between, 0.003))
        for k, truth in enumerate(LN_H):
            low, high = gain_estimate(pooled.response, k).ci95
            held += low <= np.exp(truth.real) <= high
            estimate = lag_estimate(pooled.response, k)
            turn = (-truth.imag - estimate.value + np.pi) % (2 * np.pi) - np.pi
            half = (estimate.ci95[1] - estimate.ci95[0]) / 2
            held += abs(turn) <= half
            total += 2
    assert held / total > 0.94  # 2,000 at 95 %: standard error 0.5 %; more without scatter


def test_the_covariance_is_that_of_the_mean():
    rng = np.random.default_rng(2)
    shift = np.linalg.cholesky(0.02**2 * (0.6 * np.ones((4, 4)) + 0.4 * np.eye(4)))
    means, covariances = [], []
    for _ in range(600):
        runs = [
            Response(
                np.exp(0.1j + shift @ rng.normal(size=4) + 1j * (shift @ rng.normal(size=4))),
                np.full(4, 1e-8),
                np.full(4, 1e-8),
                np.full(4, 40.0),
            )
            for _ in range(4)
        ]
        pooled = pool_runs("abcd", runs)
        means.append(
            np.concatenate(
                [pooled.log_response.mean(axis=0).real, pooled.log_response.mean(axis=0).imag]
            )
        )
        covariances.append(pooled.covariance)
    foreign = np.cov(np.array(means).T)
    np.testing.assert_allclose(np.mean(covariances, axis=0), foreign, atol=0.2 * foreign.max())
    assert np.linalg.eigvalsh(covariances[0]).min() > -1e-12
    assert (pooled.response.dof == 3).all()


def test_one_run_is_itself_and_unknown_joints_are_left_out():
    rng = np.random.default_rng(3)
    (run,) = drawn(rng, 1, 0.0, 0.003)
    pooled = pool_runs("abcd", [run])
    np.testing.assert_allclose(pooled.response.ratio, run.ratio)
    np.testing.assert_allclose(pooled.response.lag_variance, run.lag_variance)
    assert (pooled.response.dof == 40).all()
    other = drawn(rng, 1, 0.0, 0.003)[0]
    other.ratio[1] = np.nan
    both = pool_runs("abcd", [run, other])
    assert (both.names, both.runs) == (("a", "c", "d"), 2)
    # Phases near pi average to one near pi, not to zero.
    assert abs(abs(np.angle(both.response.ratio[1])) - 3.1) < 0.03
    with pytest.raises(UsageError, match="at least one run"):
        pool_runs("abcd", [])
