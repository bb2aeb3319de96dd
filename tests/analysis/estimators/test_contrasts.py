"""Contrasts between joints whose noise is shared: intervals against planted truth."""

import contrast_tables
import numpy as np
import pytest

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.intervals import response_errors
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import residual_noise, residual_spectrum
from undulog.analysis.parts.comparison.profile import scatter_of

RATE, OMEGA, JOINTS = contrast_tables.RATE, contrast_tables.OMEGA, contrast_tables.JOINTS


def judged(*case, **more):
    """Share of 95 % intervals of the contrasts that hold zero: of gain and of lag, each (11,)."""
    return contrast_tables.judged(*case, **more)[0]


@pytest.mark.parametrize(
    ("shared", "correlation"),
    [
        ("modulation", 0.9),
        *(
            pytest.param(shared, correlation, marks=pytest.mark.nightly)
            for shared in ("nothing", "additive", "modulation")
            for correlation in (0.0, 0.9)
            if (shared, correlation) != ("modulation", 0.9)
        ),
    ],
)
def test_contrasts_cover_whatever_joints_share(shared, correlation):
    """300 runs of nine joints: the standard error of one contrast's coverage is 1.3 %."""
    covered = judged(shared, correlation)
    assert 0.935 < covered[:, :JOINTS].mean() < 0.965
    assert 0.925 < covered[:, JOINTS:].mean() < 0.975  # four contrasts: 0.6 %


@pytest.mark.nightly
def test_joints_at_different_rates_and_short_records():
    for covered in judged("additive", 0.9, every=(1, 2, 3)):
        assert 0.93 < covered[:JOINTS].mean() < 0.97
    for covered in judged("additive", 0.9, duration_s=3.3):
        assert 0.92 < covered[:JOINTS].mean() < 0.98


@pytest.mark.built("tables")
@pytest.mark.nightly
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
    gain, _ = scatter_of(response_errors(fit.fundamental, still, fit.fundamental, bins))
    single = gain.variance(np.eye(3))
    np.testing.assert_allclose(single, noise.level * bins.spread / 2, rtol=1e-3)
    assert gain.variance(np.array([1.0, -1.0, 0.0])) < 1e-9 * single[0]
    # Half a turn apart: the noise that lifts the log gain of one lowers that of the other.
    assert gain.variance(np.array([1.0, 0.0, -1.0])) == pytest.approx(4 * single[0], rel=1e-2)
    assert gain.columns.shape[1] == 24


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
