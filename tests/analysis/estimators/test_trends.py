"""Trends from cycle to cycle: their columns, by their definition."""

import numpy as np
import pytest

from undulog.analysis.estimators.trends import families, finer, log_spaced, steady, transients


def test_no_trend_is_one_column_of_ones():
    none = steady(7)
    assert (none.kind, none.free, none.designs.shape) == ("steady", 0, (1, 7, 1))
    assert (none.designs == 1).all()
    assert np.isnan(none.tau[0])
    assert none.turn.tolist() == [0.0]


@pytest.mark.parametrize("place", [np.arange(12.0), np.array([0.0, 1, 3, 4, 7, 8, 9, 15])])
def test_drifts_are_polynomials_of_zero_mean(place):
    line, curve, *_ = families(place)
    assert {line.kind, curve.kind} == {"drifting"}
    assert (line.free, curve.free) == (0, 0)
    np.testing.assert_allclose(line.designs[0], np.stack([place**0, place - place.mean()], axis=1))
    gram = curve.designs[0].T @ curve.designs[0]
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-9 * gram.max())
    rest = np.linalg.lstsq(np.vander(place, 3), curve.designs[0][:, 2], rcond=None)
    assert rest[0][0] == pytest.approx(1.0)  # of k^2
    assert np.isnan(line.tau).all()


def test_the_fewest_cycles_have_the_fewest_trends():
    def kinds(count):
        return [
            (family.kind, family.designs.shape[2]) for family in families(np.arange(float(count)))
        ]

    assert kinds(5) == [("drifting", 2), ("settling", 2)]
    assert kinds(6) == [("drifting", 2), ("drifting", 3), ("settling", 2), ("ringing", 3)]


def test_transients_decay_and_turn_by_their_parameters():
    place = np.arange(5.0)
    family = transients(place, np.array([1.0, 2.0]), np.array([0.5, 1.0]))
    assert (family.kind, family.free, family.longest) == ("ringing", 2, 2.0)
    assert list(zip(family.tau, family.turn, strict=True)) == [(1, 0.5), (1, 1), (2, 0.5), (2, 1)]
    np.testing.assert_allclose(family.designs[2, :, 0], 1.0)
    np.testing.assert_allclose(family.designs[2, :, 1], np.exp(-place / 2) * np.cos(0.5 * place))
    np.testing.assert_allclose(family.designs[2, :, 2], np.exp(-place / 2) * np.sin(0.5 * place))
    plain = transients(place, np.array([3.0]), np.zeros(1))
    assert (plain.kind, plain.free, plain.designs.shape) == ("settling", 1, (1, 5, 2))
    np.testing.assert_allclose(plain.designs[0, :, 1], np.exp(-place / 3))


def test_the_grids_reach_from_the_shortest_to_half_of_the_window():
    *_, settling, ringing = families(np.arange(20.0))
    assert settling.tau[[0, -1]] == pytest.approx([0.4, 10.0])
    assert settling.tau.size == 24
    assert np.unique(ringing.tau).size == 12
    assert (ringing.tau.min(), ringing.tau.max()) == pytest.approx((0.8, 10.0))
    np.testing.assert_allclose(np.unique(ringing.turn), np.pi * np.arange(1, 16) / 16)


def test_a_finer_grid_reaches_one_step_beyond_what_is_kept():
    np.testing.assert_allclose(log_spaced(1.0, 16.0, 5), [1, 2, 4, 8, 16])
    values = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    kept = np.array([False, False, True, False, False])
    np.testing.assert_allclose(finer(values, kept, 3, 0.5, 32.0), [2.0, 4.0, 8.0])
    edge = np.array([True, False, False, False, False])
    np.testing.assert_allclose(finer(values, edge, 3, 0.5, 32.0), [0.5, 1.0, 2.0])
    other = np.array([False, False, False, False, True])
    np.testing.assert_allclose(finer(values, other, 3, 0.5, 32.0), [8.0, 16.0, 32.0])
