"""Who stands out of a profile, and what shape the rest has: planted, with known covariance."""

import math

import numpy as np
import pytest

from undulog.analysis.parts.comparison.kinds import split_of
from undulog.analysis.parts.comparison.outliers import standing_out
from undulog.analysis.parts.comparison.profile import (
    Member,
    Profile,
    Scatter,
    contrasts,
    critical_value,
    family_of,
)

SIGMA, COLUMNS = 1e-3, 24


def scatter(rng, joints, shared=0.0):
    separate, common = rng.standard_normal((joints, COLUMNS)), rng.standard_normal((1, COLUMNS))
    columns = SIGMA * (math.sqrt(1 - shared) * separate + math.sqrt(shared) * common)
    return Scatter(columns, np.zeros(joints), np.zeros(joints))


def profile(rng, values, margin=0.0, shared=0.0):
    joints = len(values)
    common = math.sqrt(shared) * rng.standard_normal()
    noise = SIGMA * (math.sqrt(1 - shared) * rng.standard_normal(joints) + common)
    place = np.arange(joints, dtype=float)
    return Profile(place, joints, values + noise, scatter(rng, joints, shared), margin)


@pytest.mark.parametrize(
    ("count", "columns", "draws", "expected", "within"),
    [
        (1, COLUMNS, 40_000, 2.064, 0.05),  # t with 24 degrees of freedom
        (10, 100, 2000, 2.87, 0.12),  # Student's t with 100 at 1 - 0.05 / 20
    ],
)
def test_the_critical_value_of_contrasts_is_the_quantile_of_the_largest(
    count, columns, draws, expected, within
):
    noise = np.random.default_rng(count).standard_normal((count, columns))
    many = Scatter(noise, np.zeros(count), np.zeros(count))
    critical = critical_value([Member(np.eye(count), many)], draws=draws)
    assert critical == pytest.approx(expected, abs=within)


@pytest.mark.nightly
@pytest.mark.parametrize("shared", [0.0, 0.8])
def test_identical_joints_rarely_differ(shared):
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(200):
        joint_profile = profile(rng, np.full(9, 0.5), shared=shared)
        critical = critical_value([family_of(joint_profile)], draws=2000)
        claims = [
            c
            for c in contrasts(joint_profile, np.ones(9, bool))
            if abs(c.value) > critical * c.error
        ]
        wrong += bool(standing_out(joint_profile, critical)) or bool(claims)
    assert wrong <= 20  # 10 are expected, 20 or more have a chance of 0.3 %


@pytest.mark.parametrize("joint", [0, 4, 8])
def test_a_joint_that_is_off_is_named_wherever_it_is(joint):
    rng = np.random.default_rng(4)
    for _ in range(20):
        values = np.full(9, 0.5)
        values[joint] += 15 * SIGMA
        joint_profile = profile(rng, values)
        deviation = standing_out(
            joint_profile, critical_value([family_of(joint_profile)], draws=2000)
        )[0]
        assert (deviation.joint, deviation.value) == (
            joint,
            pytest.approx(15 * SIGMA, abs=5 * SIGMA),
        )


def test_two_that_are_off_do_not_hide_each_other():
    rng = np.random.default_rng(5)
    values = np.full(12, 0.5)
    values[[2, 7]] -= 30 * SIGMA, 20 * SIGMA
    joint_profile = profile(rng, values)
    deviations = standing_out(joint_profile, critical_value([family_of(joint_profile)], draws=300))
    assert [deviation.joint for deviation in deviations] == [2, 7]


@pytest.mark.parametrize("first", range(1, 6))
def test_two_at_mirror_positions_are_named_unless_their_neighbours_follow(first):
    rng = np.random.default_rng(first)
    values = np.full(13, 0.5)
    values[[first, 12 - first]] -= 30 * SIGMA
    joint_profile = profile(rng, values)
    deviations = standing_out(joint_profile, critical_value([family_of(joint_profile)], draws=300))
    assert {deviation.joint for deviation in deviations} == {first, 12 - first}
    along = np.linspace(-1, 1, 13)
    smooth = profile(rng, 0.5 - 30 * SIGMA * np.exp(-(((abs(along) - 0.5) / 0.3) ** 2)))
    assert standing_out(smooth, critical_value([family_of(smooth)], draws=300)) == []


@pytest.mark.parametrize(
    ("values", "first"),
    [
        (np.where(np.arange(8) % 2, 0.4, 0.5), [0, 2, 4, 6]),
        (np.where(np.isin(np.arange(9), [1, 2, 5, 7]), 0.4, 0.5), [0, 3, 4, 6, 8]),
    ],
)
def test_two_kinds_of_joints_are_found_with_a_weak_one_among_them(values, first):
    values = values + 1e-3 * np.random.default_rng(1).standard_normal(values.size)
    split = split_of(values, 0.02)
    assert split.first.tolist() == first
    values[first[1]] -= 0.3
    assert split_of(np.asarray(values), 0.02) is not None


@pytest.mark.parametrize(
    "values",
    [
        np.full(9, 0.5),
        np.linspace(0.4, 0.6, 9),
        0.5 - 0.2 * np.linspace(-1, 1, 9) ** 2,
        np.where(np.arange(9) == 4, 0.3, 0.5),
    ],
)
def test_one_kind_is_not_divided(values):
    noise = 1e-3 * np.random.default_rng(2).standard_normal(values.size)
    assert split_of(values + noise, 0.02) is None


def test_two_batches_one_behind_the_other_are_two_kinds():
    noise = 0.002 * np.random.default_rng(1).normal(size=13)
    split = split_of(0.1 * (np.arange(13) > 5) + noise, 0.02)
    assert split is not None
    assert split.first.tolist() == list(range(6))
    decay = np.exp(-np.arange(13.0))
    assert split_of(decay + 0.1 * noise, 0.02) is None


def test_below_the_margin_nobody_is_named():
    rng = np.random.default_rng(6)
    values = np.full(9, 0.5)
    values[3] += 15 * SIGMA
    joint_profile = profile(rng, values, margin=0.02)
    assert standing_out(joint_profile, critical_value([family_of(joint_profile)], draws=300)) == []


def test_a_joint_at_the_margin_is_named():
    """Its interval holds the margin, so that it can't be called alike."""
    named = 0
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        values = np.full(9, 0.5)
        values[3] += 0.02
        joint_profile = profile(rng, values, margin=0.02)
        deviations = standing_out(
            joint_profile, critical_value([family_of(joint_profile)], draws=300)
        )
        named += [deviation.joint for deviation in deviations] == [3]
    assert named >= 18


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        (lambda x: 0.05 * x, "trend"),
        (lambda x: 0.05 * np.abs(x), "mirror"),
        (lambda x: 0.05 * (np.abs(x) > 0.99), "ends"),
    ],
)
def test_a_smooth_profile_is_a_shape_and_names_nobody(shape, kind):
    joint_profile = profile(np.random.default_rng(7), 0.5 + shape(np.linspace(-1, 1, 13)))
    critical = critical_value([family_of(joint_profile)], draws=300)
    assert standing_out(joint_profile, critical) == []
    by_kind = {contrast.kind: contrast for contrast in contrasts(joint_profile, np.ones(13, bool))}
    assert abs(by_kind[kind].value) > critical * by_kind[kind].error


def test_a_joint_stands_out_of_a_profile_too():
    rng = np.random.default_rng(8)
    values = 0.5 + 0.05 * np.linspace(-1, 1, 13)
    values[5] -= 0.05
    joint_profile = profile(rng, values)
    (deviation,) = standing_out(
        joint_profile, critical_value([family_of(joint_profile)], draws=300)
    )
    assert (deviation.joint, deviation.value) == (5, pytest.approx(-0.05, abs=0.01))
