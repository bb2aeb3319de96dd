"""Sums over cycles against sums taken one by one, and cosines against NumPy's."""

import numpy as np

from undulog.analysis.estimators.demodulation import cycle_sums, starts_of
from undulog.analysis.estimators.harmonic import cos_sin


def test_sums_of_each_cycle_empty_ones_too():
    rng = np.random.default_rng(1)
    t_s = np.sort(rng.uniform(0, 10, 200))
    t_s = t_s[(t_s < 3.2) | (t_s > 5.1)]
    edges = np.array([-2.0, -1.0, 0.7, 3.3, 4.0, 5.0, 7.7, 10.5, 11.0])
    values = rng.standard_normal((2, 3, t_s.size))
    sums = cycle_sums(values, starts_of(t_s, edges))
    for k in range(edges.size - 1):
        inside = (t_s >= edges[k]) & (t_s < edges[k + 1])
        np.testing.assert_allclose(sums[..., k], values[..., inside].sum(axis=-1), atol=1e-12)
    assert not cycle_sums(values, starts_of(t_s, np.array([-3.0, -2.0, -1.0]))).any()


def test_cosine_and_sine_to_rounding():
    rng = np.random.default_rng(2)
    corners = np.arange(-8, 9) * np.pi / 4
    for angle in (rng.uniform(-2e4, 2e4, 100_000), corners, corners * (1 + 1e-15)):
        cosine, sine = cos_sin(angle)
        np.testing.assert_allclose(cosine, np.cos(angle), rtol=0, atol=2e-15)
        np.testing.assert_allclose(sine, np.sin(angle), rtol=0, atol=2e-15)
