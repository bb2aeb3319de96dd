"""Names of joints against commands, on planted permutations and on what only looks like one."""

import numpy as np
import pytest

from undulog.capture.common.errors import DataError
from undulog.capture.judgement.naming import (
    ExplanationKind,
    Naming,
    NamingVerdict,
    in_words,
    permutation_of,
)

RATE_HZ = 50.0
COUNTS = (3, 6, 13, 60)


def run(joints, step_rad, order=None, *, seed=0, seconds=12.0, rate_hz=RATE_HZ, **facts):
    """Commands and positions of a wave, servos of nearly one gain and lag, and some noise.

    Args:
        step_rad: Phase from joint to joint.
        order: Joint k carries out the command of joint ``order[k]``.
        facts: ``hz``, ``lag`` [rad], ``noise`` [rad], ``spread`` of log gain and of lag [rad],
            and by joint ``sizes`` [rad], ``gains``, ``lags`` [rad], ``inverted``.
    """
    facts = {"hz": 0.8, "lag": 0.2, "noise": 0.01, "spread": 0.03} | facts
    draw = np.random.default_rng(seed)
    turn = 2 * np.pi * facts["hz"] * np.arange(round(seconds * rate_hz))[:, None] / rate_hz
    place = np.arange(joints)
    sizes = facts.get("sizes", 0.4)
    gains = 0.93 * np.exp(facts["spread"] * draw.normal(size=joints)) * facts.get("gains", 1.0)
    lags = facts["lag"] + facts["spread"] * draw.normal(size=joints) + facts.get("lags", 0.0)
    commands = sizes * np.sin(turn - step_rad * place)
    positions = sizes * gains * np.sin(turn - step_rad * place - lags)
    positions[:, list(facts.get("inverted", ()))] *= -1
    positions = positions if order is None else positions[:, list(order)]
    return commands, positions + facts["noise"] * draw.normal(size=positions.shape)


def naming_of(commands, positions, rate_hz=RATE_HZ):
    return permutation_of(commands, positions, 1 / rate_hz)


def shifted(joints, by=1):
    return tuple(np.roll(np.arange(joints), -by).tolist())


def swapped(joints, first, second):
    order = list(range(joints))
    order[first], order[second] = second, first
    return tuple(order)


@pytest.mark.parametrize("joints", COUNTS)
@pytest.mark.parametrize("step_rad", [0.6, -0.4, 1.1])
def test_names_of_sound_joints_fit(joints, step_rad):
    naming = naming_of(*run(joints, step_rad))
    assert naming.verdict is NamingVerdict.FITS
    assert naming.permutation == tuple(range(joints))
    assert in_words(naming, [str(k) for k in range(joints)]) == ""


@pytest.mark.parametrize("joints", COUNTS)
@pytest.mark.parametrize("by", [1, -1])
def test_the_end_joint_tells_a_shift_by_one_from_a_lag_of_all(joints, by):
    naming = naming_of(*run(joints, 0.7, shifted(joints, by)))
    assert naming.verdict is NamingVerdict.PERMUTED
    assert naming.permutation == shifted(joints, by)
    assert (joints - 1 if by > 0 else 0) in naming.decided_by


@pytest.mark.parametrize("joints", [3, 6, 13])
def test_in_a_uniform_gait_of_whole_waves_a_shift_and_a_lag_are_both_stated(joints):
    naming = naming_of(*run(joints, 2 * np.pi / joints, shifted(joints)))
    assert naming.verdict is NamingVerdict.EITHER
    assert naming.permutation is None
    kinds = [alternative.kind for alternative in naming.alternatives]
    assert kinds == [ExplanationKind.PERMUTED, ExplanationKind.AS_NAMED]
    assert naming.alternatives[0].permutation == shifted(joints)
    late = naming.alternatives[1].delay_s - naming.alternatives[0].delay_s
    assert late == pytest.approx(1 / joints / 0.8, abs=0.02)  # a joint's share of the period
    assert in_words(naming, "abcdefghijklm"[:joints]).startswith(
        "the names are shifted by 1 joint: a carries out b's, or all joints lag by 0."
    )


def test_amplitudes_tell_a_shift_from_a_lag():
    sizes = np.linspace(0.12, 0.4, 8)
    naming = naming_of(*run(8, np.pi / 4, shifted(8), sizes=sizes))
    assert (naming.verdict, naming.permutation) == (NamingVerdict.PERMUTED, shifted(8))
    assert naming_of(*run(8, np.pi / 4, sizes=sizes)).verdict is NamingVerdict.FITS


def test_a_second_gait_tells_a_shift_from_a_lag():
    first, second = (run(8, step, shifted(8), hz=hz) for step, hz in ((0.785, 0.8), (-0.785, 1.1)))
    both = [np.concatenate(parts) for parts in zip(first, second, strict=True)]
    naming = naming_of(*both)
    assert (naming.verdict, naming.permutation) == (NamingVerdict.PERMUTED, shifted(8))


@pytest.mark.parametrize("joints", COUNTS)
@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 2)])
def test_two_swapped_joints_are_a_permutation_of_two(joints, pair):
    naming = naming_of(*run(joints, 0.6, swapped(joints, *pair)))
    assert (naming.verdict, naming.permutation) == (NamingVerdict.PERMUTED, swapped(joints, *pair))
    assert set(pair) <= set(naming.decided_by)
    names = [f"m{k}" for k in range(joints)]
    assert in_words(naming, names) == f"m{pair[0]} and m{pair[1]} carry out each other's command"


def test_neighbours_whose_commands_hardly_differ_are_swapped_or_have_lags_of_their_own():
    naming = naming_of(*run(8, 0.35, swapped(8, 3, 4), spread=0.0))
    assert naming.verdict is NamingVerdict.EITHER
    assert {alternative.kind for alternative in naming.alternatives} == {
        ExplanationKind.PERMUTED,
        ExplanationKind.OWN_LAGS,
    }
    assert "m3 and m4 carry out each other's command" in in_words(
        naming, [f"m{k}" for k in range(8)]
    )


@pytest.mark.parametrize("joints", [3, 6, 13])
def test_a_chain_that_is_read_from_the_other_end_is_found(joints):
    order = tuple(range(joints))[::-1]
    naming = naming_of(*run(joints, 0.5, order))
    assert (naming.verdict, naming.permutation) == (NamingVerdict.PERMUTED, order)


def test_any_order_of_six_joints_is_found():
    for seed in range(20):
        order = tuple(np.random.default_rng(seed).permutation(6).tolist())
        naming = naming_of(*run(6, 0.9, order, seed=seed))
        assert naming.permutation == order


def test_identical_commands_tell_nothing_and_are_named():
    naming = naming_of(*run(5, 0.0, shifted(5)))
    assert naming.verdict is NamingVerdict.FITS
    assert naming.interchangeable == ((0, 1, 2, 3, 4),)


def test_in_a_standing_wave_two_swapped_and_two_inverted_joints_are_both_stated():
    naming = naming_of(*run(8, np.pi, swapped(8, 0, 1)))
    assert naming.verdict is NamingVerdict.EITHER
    assert {alternative.kind for alternative in naming.alternatives} == {
        ExplanationKind.PERMUTED,
        ExplanationKind.INVERTED,
    }
    assert naming.interchangeable == ((0, 2, 4, 6), (1, 3, 5, 7))
    words = in_words(naming, [f"m{k}" for k in range(8)])
    assert "m0 and m1 carry out each other's command" in words
    assert "inverted: m0, m1" in words


def test_amplitudes_tell_two_swapped_joints_of_a_standing_wave():
    sizes = 0.4 * np.linspace(0.3, 1.0, 8)
    naming = naming_of(*run(8, 0.0, swapped(8, 1, 6), sizes=sizes))
    assert (naming.verdict, naming.permutation) == (NamingVerdict.PERMUTED, swapped(8, 1, 6))
    assert naming_of(*run(8, 0.0, sizes=sizes)).verdict is NamingVerdict.FITS


def test_names_at_mirror_places_of_a_mirror_symmetric_gait_fit():
    sizes = 0.4 * np.cos(0.2 * (np.arange(9) - 4))
    naming = naming_of(*run(9, 0.0, tuple(range(9))[::-1], sizes=sizes))
    assert naming.verdict is NamingVerdict.FITS
    assert (0, 8) in naming.interchangeable


FAULTS = {
    "weak": {"gains": np.array([1, 1, 1, 0.5, 1, 1, 1, 1])},
    "dead": {"gains": np.array([1, 1, 0, 1, 1, 1, 1, 1.0])},
    "late": {"lags": np.array([0, 0, 0, 0.6, 0, 0, 0, 0])},
    "very late": {"lags": np.array([0, 0, 0, 0, 0, 0, 0, 1.2])},
    "two late": {"lags": np.array([0, 0.7, 0, 0, 0, 0.5, 0, 0])},
    "inverted": {"inverted": (4,)},
    "inverted end": {"inverted": (7,)},
    "two inverted": {"inverted": (2, 5)},
    "two kinds": {"lags": 0.4 * (np.arange(8) % 2), "gains": 1 - 0.2 * (np.arange(8) % 2)},
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("step_rad", [0.6, -0.3])
def test_faults_of_joints_are_no_permutation(fault, step_rad):
    naming = naming_of(*run(8, step_rad, **FAULTS[fault]))
    assert naming.verdict is NamingVerdict.FITS


def test_a_late_end_joint_of_soft_servos_is_late_or_the_names_are_shifted():
    """A lag of all beyond the phase of a joint, and an end joint that is nearly at the first's."""
    naming = naming_of(
        *run(8, 0.6, lag=0.75, lags=np.array([0, 0, 0, 0, 0, 0, 0, 1.75]), spread=0.0)
    )
    assert naming.verdict is NamingVerdict.EITHER
    assert {alternative.kind for alternative in naming.alternatives} == {
        ExplanationKind.PERMUTED,
        ExplanationKind.OWN_LAGS,
    }
    assert naming.decided_by == (7,)


def test_a_dead_joint_does_not_hide_a_shift():
    naming = naming_of(*run(8, 0.6, shifted(8), **FAULTS["dead"]))
    assert naming.permutation == shifted(8)


def test_joints_that_stand_on_command_count_by_standing():
    commands, positions = run(6, 0.6)
    commands[:, 5], positions[:, 5] = 0.0, 0.001 * positions[:, 5]
    assert naming_of(commands, positions).verdict is NamingVerdict.FITS
    naming = naming_of(commands, positions[:, list(swapped(6, 1, 5))])
    assert naming.permutation == swapped(6, 1, 5)


@pytest.mark.parametrize(("rate_hz", "hz"), [(20.0, 8.0), (20.0, 0.3), (1000.0, 0.8)])
def test_slow_and_fast_sampling_give_the_same(rate_hz, hz):
    for order in (None, shifted(7)):
        naming = naming_of(*run(7, 0.6, order, rate_hz=rate_hz, hz=hz), rate_hz)
        assert naming.permutation == (order or tuple(range(7)))


def test_noise_alone_decides_nothing():
    draw = np.random.default_rng(3)
    commands, _ = run(6, 0.6)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(size=commands.shape)
        assert naming_of(commands, noise).verdict is NamingVerdict.UNKNOWN
    assert naming_of(*run(6, 0.6, shifted(6), noise=0.5)).verdict is NamingVerdict.UNKNOWN
    walks = np.cumsum(draw.normal(size=(2, 600, 6)), axis=1)
    assert naming_of(*walks).verdict in (NamingVerdict.UNKNOWN, NamingVerdict.FITS)


def test_too_little_tells_nothing():
    commands, positions = run(6, 0.6)
    for part in (
        (commands[:, :1], positions[:, :1]),
        (commands[:3], positions[:3]),
        (commands[:0], positions[:0]),
        (commands[:70], positions[:70]),  # 1.1 periods
        (np.zeros_like(commands), positions),
        (commands, np.zeros_like(positions)),
    ):
        assert naming_of(*part) == Naming(NamingVerdict.UNKNOWN)


@pytest.mark.parametrize(
    ("commands", "positions", "step_s", "why"),
    [
        (np.zeros((9, 2)), np.zeros((9, 3)), 0.1, "both take samples times joints"),
        (np.zeros(9), np.zeros(9), 0.1, "both take samples times joints"),
        (np.full((9, 2), np.nan), np.zeros((9, 2)), 0.1, "must be finite"),
        (np.zeros((9, 2)), np.zeros((9, 2)), 0.0, "a sampling interval of 0 s is none"),
        (np.zeros((9, 2)), np.zeros((9, 2)), np.inf, "a sampling interval of inf s is none"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(commands, positions, step_s, why):
    with pytest.raises(DataError, match=why):
        permutation_of(commands, positions, step_s)


NO_PERMUTATION = ("sound", "weak", "dead", "inverted", "late", "two late", "taper")


def drawn(seed, truth):
    """A chain, gait and servos drawn at random, with one planted fault or order."""
    draw = np.random.default_rng([seed, sum(map(ord, truth))])
    joints = int(draw.choice([3, 4, 5, 6, 8, 9, 12, 13, 16, 25, 40, 60]))
    step = draw.choice([-1, 1]) * draw.uniform(0.1, 1.6)
    rate = float(draw.choice([20, 50, 100]))
    facts = {
        "hz": draw.uniform(0.3, 1.5),
        "lag": draw.uniform(0.02, 0.9),
        "noise": 10 ** draw.uniform(-3, -1.3),
        "seconds": draw.uniform(8, 25),
        "spread": draw.uniform(0, 0.08),
        "rate_hz": rate,
        "seed": seed,
    }
    at, beside = draw.choice(joints, 2, replace=False)
    at_joint = np.arange(joints) == at
    match truth:
        case "weak":
            facts["gains"] = np.where(at_joint, draw.uniform(0.2, 0.8), 1.0)
        case "dead":
            facts["gains"] = np.where(at_joint, 0.0, 1.0)
        case "inverted":
            facts["inverted"] = (int(at),)
        case "late":
            facts["lags"] = np.where(at_joint, draw.uniform(0.2, 1.2), 0.0)
        case "two late":
            facts["lags"] = 0.5 * (at_joint | (np.arange(joints) == beside))
        case "taper":
            facts["sizes"] = 0.4 * np.linspace(draw.uniform(0.3, 1), 1, joints)
    orders = {
        "shift": shifted(joints, int(draw.choice([-1, 1]))),
        "swap": swapped(joints, int(at), int(beside)),
        "reverse": tuple(range(joints))[::-1],
    }
    order = orders.get(truth, tuple(range(joints)))
    return (*run(joints, step, order, **facts), rate), order


@pytest.mark.nightly
@pytest.mark.parametrize(
    "truth", ["sound", "weak", "dead", "inverted", "late", "two late", "taper"]
)
def test_of_two_hundred_drawn_chains_without_a_permutation_none_is_said_to_have_one(truth):
    namings = [naming_of(*drawn(seed, truth)[0]) for seed in range(200)]
    assert sum(naming.verdict is NamingVerdict.PERMUTED for naming in namings) == 0
    assert sum(naming.verdict is NamingVerdict.EITHER for naming in namings) <= 30


@pytest.mark.nightly
@pytest.mark.parametrize("truth", ["shift", "swap", "reverse"])
def test_of_two_hundred_drawn_permutations_four_fifths_stand_and_few_others_do(truth):
    right = wrong = 0
    for seed in range(200):
        arrays, order = drawn(seed, truth)
        naming = naming_of(*arrays)
        stands = any(alternative.permutation == order for alternative in naming.alternatives)
        right += stands and naming.verdict is not NamingVerdict.FITS
        wrong += naming.verdict is NamingVerdict.PERMUTED and not stands
    assert right >= 160
    assert wrong <= 6
