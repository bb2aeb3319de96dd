"""Runs that differ by more than their own noise: intervals hold, a linear robot stays linear."""

import dataclasses
import math

import kick_tables
import numpy as np
import pytest

from support.kick_runs import kicked
from undulog.analysis.experiment.answer import kick_answer
from undulog.analysis.experiment.kick_coupling import kick_coupling
from undulog.analysis.experiment.kick_runs import Kick, KickKind, sort_kicks
from undulog.analysis.experiment.local_coupling import local_matrices
from undulog.analysis.experiment.run_scatter import run_errors

pytestmark = pytest.mark.nightly

H, C = kick_tables.chain(5)
KICKS = kick_tables.plan(5)


def runs(random, scatter_deg, **how):
    return kicked(random, H, C, KICKS, math.radians(scatter_deg), **how)


def coupled(experiment):
    return kick_coupling(experiment, lambda _: None)


@pytest.mark.parametrize(
    ("scatter_deg", "how", "base_runs"),
    [(0.0, "each", 6), (0.1, "each", 6)]
    + [pytest.param(0.1, "each", 1, marks=pytest.mark.nightly)]
    + [pytest.param(0.1, how, 6, marks=pytest.mark.nightly) for how in ("common", "odd", "drift")]
    + [pytest.param(sd, "each", 6, marks=pytest.mark.nightly) for sd in (0.03, 0.3)],
)
def test_intervals_hold_and_a_linear_robot_is_linear(scatter_deg, how, base_runs):
    random, options = np.random.default_rng(3), {"how": how, "base_runs": base_runs}
    shares = kick_tables.row(random, 50, 5, scatter_deg, **options, index=scatter_deg == 0.1)
    assert min(shares[name] for name in "PRGS") >= 0.91
    assert shares["worst"] >= 0.90  # of one row, 250 elements that share an estimate of scatter
    assert shares["nonlinear"] <= 0.05
    assert shares["rows"] <= 0.12
    # Not by being wide: at most half more than what the scatter itself makes of a difference.
    sigma = math.hypot(math.radians(scatter_deg), kick_tables.NOISE)
    assert shares["half"] <= 1.5 * 1.96 * math.sqrt(2) * sigma / (2 * kick_tables.KICK)


def test_without_coupling_the_headline_shows_none():
    shares = kick_tables.row(np.random.default_rng(4), 200, 5, 0.1, coupled=False, index=False)
    assert shares["headline"] <= 0.05


def test_nonlinearity_is_still_found():
    """A servo whose gain falls with amplitude, 14 % nonlinear, under scatter of 0.03 degrees."""
    random = np.random.default_rng(5)
    shown = 0
    for _ in range(20):
        coupling = coupled(runs(random, 0.03, bend=0.4))
        shown += coupling.nonlinearity.ci95[0] > 0.0
    assert shown >= 19


@pytest.mark.parametrize("common", [False, True])
def test_the_errors_of_a_run_are_those_planted(common):
    """Their mean over many experiments, and how the joints' errors go together."""
    m, sigma, count = 4, 2e-3, 400
    kicks = kick_tables.plan(m, 3)
    H, c = kick_tables.chain(m)
    random = np.random.default_rng(6)
    L = H * c[None, :] / (H @ c)[:, None]
    variances, correlated = [], []
    how = {"scatter": sigma, "how": "common" if common else "each"}
    for answers in kick_tables.experiments(random, count, kicks, H, c, **how):
        variance = np.hstack([answers.phase_variance, answers.log_gain_variance])
        errors = run_errors(kicks, answers.log, variance, (L, L))
        variances.append(errors.variance)
        correlated.append(errors.correlation[0, 1])
        # Repeats, others' pairs of two kinds, the rows' sum.
        assert errors.dof == 2 + 2 * (m - 2) + 1
    expected = sigma**2 + kick_tables.NOISE**2
    np.testing.assert_allclose(np.mean(variances, axis=0), expected, rtol=0.1)
    # Each estimate has the spread of a mean of seven squares.
    assert np.std(variances, axis=0).mean() == pytest.approx(expected * math.sqrt(2 / 7), rel=0.15)
    if common:  # of few products, and never above 1: a little too small
        assert 0.85 < np.mean(correlated) <= 1.0
    else:
        assert np.mean(correlated) == pytest.approx(0.0, abs=0.05)


def test_a_servo_that_saturates_does_not_look_like_scatter():
    """Its answer to its own kicks bends; its neighbours' runs are as steady as before."""
    straight = runs(np.random.default_rng(2), 0.0)
    bent = straight.ratio.copy()
    for k, kick in enumerate(KICKS):
        if kick is not None and kick.joint == 2:
            bent[k, 2] *= np.exp(2j * kick.size**2)  # 0.3 degrees
    steady, two = (
        coupled(measured) for measured in (straight, dataclasses.replace(straight, ratio=bent))
    )
    np.testing.assert_allclose(steady.P.ci95_half, two.P.ci95_half, rtol=1e-6)


def test_a_copied_file_is_no_repeat():
    H, c = kick_tables.chain(4)
    kicks = kick_tables.plan(4, 1)
    (answers,) = kick_tables.experiments(np.random.default_rng(1), 1, kicks, H, c, scatter=1e-3)
    twice = [*kicks, None]
    again = answers.select([*range(len(kicks)), 0])
    original, two = (
        local_matrices(k, a, amplitude=True) for k, a in ((kicks, answers), (twice, again))
    )
    assert original.errors.dof == two.errors.dof
    np.testing.assert_allclose(original.P.error, two.P.error)


def test_sums_that_fail_widen_and_come_first():
    """As if every run had been measured before it settled: responses go on turning."""
    warnings = []
    coupling = kick_coupling(runs(np.random.default_rng(7), 0.01, late=0.06), warnings.append)
    assert not coupling.checks_pass
    answer = kick_answer(coupling)
    assert answer.startswith("coupling around this gait: doubtful, since rows of P don't sum to 1")
    assert any("let each run settle longer" in warning for warning in warnings)
    assert coupling.scatter.widened > 3.0
    # Every element is off by 0.06, and its interval has the truth in spite of it.
    L = H * C[None, :] / (H @ C)[:, None]
    off = np.abs(np.array(coupling.P.value) - L.real)
    assert np.mean(off <= np.array(coupling.P.ci95_half)) > 0.91


def answered(size, scatter_deg):
    coupling = coupled(runs(np.random.default_rng(8), scatter_deg, size=size))
    return coupling, kick_answer(coupling)


def test_kicks_that_fit_are_not_mentioned():
    coupling, answer = answered(1.0, 0.03)
    assert coupling.kick_size.verdict == "fits"
    assert "kicks of" not in answer
    assert coupling.kick_size.resolved < 0.1


@pytest.mark.parametrize(("size", "scatter_deg"), [(1.0, 0.5), (0.1, 0.05)])
def test_kicks_too_small_are_stated_with_what_to_record(size, scatter_deg):
    coupling, answer = answered(size, scatter_deg)
    assert coupling.kick_size.verdict == "too small"
    assert f"kicks of {0.05 * size:.2g} rad are too small" in answer
    assert "to show 0.1, record kicks of" in answer


def test_what_is_to_be_recorded_would_do():
    """The size or number of repeats that the answer asks for brings the interval to 0.1."""
    coupling, answer = answered(0.1, 0.03)
    again, _ = answered(float(answer.rpartition("record kicks of ")[2].split()[0]) / 0.05, 0.03)
    assert again.kick_size.verdict == "fits"
    assert coupling.kick_size.resolved > 0.1


def test_kicks_too_large_are_stated():
    coupling, answer = answered(6.0, 0.03)
    assert coupling.kick_size.phase_rad == pytest.approx(0.3)
    assert coupling.kick_size.verdict == "too large"
    assert "kicks of 0.3 are too large for a derivative" in answer


def test_curved_answers_are_stated():
    """Responses that bend within a kick of 0.05: mostly of second order."""
    experiment = runs(np.random.default_rng(9), 0.0)
    bent = experiment.ratio.copy()
    for k, kick in enumerate(KICKS):
        if kick is not None and kick.kind is KickKind.PHASE:
            bent[k] *= np.exp(8j * kick.size**2)
    coupling = coupled(dataclasses.replace(experiment, ratio=bent))
    assert coupling.kick_size.verdict == "too large"
    assert "of second order; record kicks of" in kick_answer(coupling)


@pytest.mark.parametrize("size", [0.004, 0.3])
def test_kicks_of_unusual_size_are_found(size):
    kicks = [Kick(j, KickKind.PHASE, s * size) for j in range(5) for s in (1, -1)]
    off = np.zeros((11, 5), dtype=complex)
    for k, kick in enumerate(kicks, start=1):
        off[k, kick.joint] = 1j * kick.size
    sorted_kicks = sort_kicks(C * np.exp(off))
    assert sorted_kicks.base == (0,)
    assert [sorted_kicks.kicks[k].size for k in range(1, 11)] == pytest.approx(
        [k.size for k in kicks]
    )
