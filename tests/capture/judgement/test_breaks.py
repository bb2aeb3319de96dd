"""Breaks of a regression against least squares by columns, and on work with few motions."""

import numpy as np
import pytest

from undulog.capture.judgement.blocks import TERMS, moments_of
from undulog.capture.judgement.breaks import breaks_of
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples

BLOCKS, WIDTH = 30, 40


def columns(rng):
    """Return one, a wandering response, its negative rate and noise, shape (4, n)."""
    p = np.cumsum(rng.normal(size=BLOCKS * WIDTH)) / 10
    return np.stack([np.ones_like(p), p, -np.gradient(p), rng.normal(size=p.size)])


def moments(rows):
    return moments_of(rows, rows, WIDTH * np.arange(BLOCKS), WIDTH)


def design(rows, q, cut):
    """Return the terms, of gain and lag a change of the offset, and the change, as columns."""
    behind = np.arange(rows.shape[1]) >= (cut + 1) * WIDTH
    steps = [np.where(behind, rows[term], 0.0) for term in sorted({0, q})]
    return np.stack([*rows[:TERMS], *steps], axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_a_break_is_that_of_least_squares_with_a_column_of_its_own(seed):
    rows = columns(np.random.default_rng(seed))
    breaks = breaks_of(moments(rows))
    for q in range(TERMS):
        for cut in range(BLOCKS - 1):
            x = design(rows, q, cut)
            fitted, squares, *_ = np.linalg.lstsq(x, rows[TERMS], rcond=None)
            without = np.linalg.lstsq(x[:, :-1], rows[TERMS], rcond=None)[1]
            assert breaks.change[q, cut] == pytest.approx(fitted[-1], rel=1e-6, abs=1e-9)
            assert breaks.before[q, cut] == pytest.approx(fitted[q], rel=1e-6, abs=1e-9)
            assert breaks.left[q, cut] == pytest.approx(squares[0], rel=1e-9)
            assert breaks.drop[q, cut] == pytest.approx(without[0] - squares[0], abs=1e-6)


def test_the_error_of_a_break_is_that_of_sums_over_blocks():
    rows = columns(np.random.default_rng(7))
    breaks = breaks_of(moments(rows))
    q, cut = 1, 5
    x = design(rows, q, cut)
    left = rows[TERMS] - x @ np.linalg.lstsq(x, rows[TERMS], rcond=None)[0]
    free = x[:, -1] - x[:, :-1] @ np.linalg.lstsq(x[:, :-1], x[:, -1], rcond=None)[0]
    scores, power = ((free * part).reshape(BLOCKS, WIDTH).sum(axis=1) for part in (left, free))
    blocks = power.sum() ** 2 / (power**2).sum()
    assert breaks.freedom[q, cut] == pytest.approx(blocks - 2)
    rho = max(scores[1:] @ scores[:-1] / (scores @ scores), 0.0)
    square = scores @ scores * (1 + rho) / (1 - rho) * blocks / (blocks - 2)
    assert breaks.error[q, cut] == pytest.approx(np.sqrt(square) / power.sum())


def test_the_error_holds_the_change_of_noise_that_differs_from_block_to_block():
    """Of 400 draws at one time, though one block in three is five times as loud."""
    beyond, draws = 0, 400
    for seed in range(draws):
        rng = np.random.default_rng(1000 + seed)
        rows = columns(rng)
        rows[TERMS] *= np.repeat(rng.choice([1.0, 1.0, 5.0], BLOCKS), WIDTH)
        breaks = breaks_of(moments(rows))
        beyond += abs(breaks.change[0, 5]) > 2.2 * breaks.error[0, 5]
    assert beyond <= 0.05 * draws + 3 * np.sqrt(0.05 * draws)


def test_a_term_that_never_moves_has_no_break():
    rows = columns(np.random.default_rng(3))
    rows[1:TERMS] = 0.0
    breaks = breaks_of(moments(rows))
    assert (breaks.freedom[1:] < 1).all()
    assert (breaks.change[1:] == 0).all()
    assert np.isfinite(breaks.error).all()


T = np.arange(0.0, 90.0, 0.02)
MOVES_S = np.arange(3.0, 86.0, 4.1)


def work(*, gain=0.0, offset=0.0, late_s=0.0, from_s=37.0, joints=3, seed=0):
    """Return an arm that goes from place to place, of which the first joint changes at a time."""
    rng, recorded = np.random.default_rng(seed), []
    for k in range(joints):
        places = rng.uniform(-0.8, 0.8, len(MOVES_S))

        def path(t, k=k, places=places):
            goes = np.clip((t[:, None] - MOVES_S - 0.4 * k) / 1.5, 0.0, 1.0)
            return np.diff(places, prepend=0.0) @ (goes * goes * (3 - 2 * goes)).T

        after = (from_s <= T) & (k == 0)
        position = (0.95 + gain * after) * path(T - 0.06 - late_s * after) + offset * after
        # It rests where friction lets it.
        rest = np.interp(T, MOVES_S, rng.normal(scale=0.006, size=len(MOVES_S)))
        noise = rng.normal(scale=0.001, size=T.size)
        recorded.append(
            RecordedJoint(f"j{k}", Samples(T, path(T)), Samples(T, position + rest + noise))
        )
    return recorded


@pytest.mark.parametrize(
    ("joints", "quantity", "size", "change"),
    [
        (1, "gain", -0.25 / 0.95, {"gain": -0.25}),
        (3, "gain", -0.25 / 0.95, {"gain": -0.25}),
        (1, "offset", 0.09, {"offset": 0.09}),
        (3, "offset", 0.09, {"offset": 0.09}),
        (3, "lag", 0.15, {"late_s": 0.15}),
    ],
)
def test_a_change_in_work_of_few_motions_has_its_size_and_time(joints, quantity, size, change):
    (stated,) = judge(work(**change, joints=joints)).changes
    assert (stated.joint, stated.quantity) == ("j0", quantity)
    assert stated.change == pytest.approx(size, rel=0.15)
    assert stated.onset_s[0] - 4 <= 37.0 <= stated.onset_s[1] + 4
    assert stated.until_s is None


@pytest.mark.parametrize("joints", [1, 3])
def test_work_without_a_change_has_none(joints):
    assert all(judge(work(joints=joints, seed=seed)).changes == () for seed in range(12))


def test_the_half_width_of_a_gain_is_relative_as_the_gain_is():
    (stated,) = judge(work(gain=-0.25)).changes
    (other,) = judge(work(gain=0.25)).changes
    # 0.95 before; the same step from 0.95 up and down, in units of what was before.
    assert stated.change == pytest.approx(-other.change, rel=0.05)
    assert stated.half_width < 0.1 * abs(stated.change)
