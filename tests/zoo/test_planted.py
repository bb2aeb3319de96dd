"""Planted faults of the bench: they are what they claim to be."""

import numpy as np
import pytest

from zoo.healthy import DEGREE
from zoo.oracle import exposed, half_width, needed_s
from zoo.planted import ANY, LEAST_GAIN, SCATTERS, Least, hold
from zoo.planted_faults import FAULTS, KINDS, draw, plant, record

BASE = ("white", "quantised_encoder", "delayed", "short_chain", "many_joints")
"""Kinds whose positions are quickly computed; of ``delayed`` and others by the fault's choice."""


def planted(name, seed, **more):
    healthy, fault = plant(name, seed, kinds=BASE, **more)
    assert healthy is not None, f"{name}, seed {seed}: nothing planted"
    return healthy, fault


def positions(healthy, fault, seed=1):
    return record(healthy, fault.changes, seed).positions, record(healthy, (), seed).positions


def test_there_are_enough_faults_and_their_kinds_exist():
    assert len(FAULTS) >= 24
    assert {kind for fault in FAULTS.values() for kind in fault.kinds} <= KINDS.keys()
    assert set(ANY) >= {"twin", "arm", "two_servos"}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_changes_its_joints_alone_and_from_its_onset_on(name):
    healthy, fault = planted(name, 3)
    faulty, sound = positions(healthy, fault)
    differs = np.abs(faulty - sound) > 1e-12
    places = {truth.joint for truth in fault.joints}
    assert set(np.flatnonzero(differs.any(axis=0))) == places
    for truth in fault.joints:
        assert truth.names <= truth.allowed
        assert truth.names or truth.quantities
        assert (truth.since_s is not None) == FAULTS[name].change
        when = healthy.t_s[differs[:, truth.joint]]
        if truth.since_s is not None:
            assert when[0] >= truth.since_s - 1e-9
        if truth.until_s is not None:
            assert when[-1] <= truth.until_s + 1e-9


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_has_time_to_be_seen(name):
    healthy, fault = planted(name, 5)
    for truth in fault.joints:
        when = exposed(healthy, truth.joint)
        needed = needed_s(healthy)
        assert when.sum() * healthy.step_s >= needed - 1e-9
        if truth.since_s is not None:
            before = when & (healthy.t_s < truth.since_s + healthy.step_s)
            assert before.sum() * healthy.step_s >= needed - 1e-6
            assert (when & ~before).sum() * healthy.step_s >= needed - 2 * healthy.step_s


@pytest.mark.parametrize("least", [Least(2.0), Least(3.0), Least(3.0, 1.5)])
def test_a_gain_is_as_large_as_the_oracle_wants_it(least):
    healthy, fault = planted("gain", 2, least=least)
    (truth,) = fault.joints
    way = healthy.way[:, truth.joint] - healthy.middle[truth.joint]
    moved = fault.changes[0].position - healthy.middle[truth.joint]
    assert moved == pytest.approx((1 + truth.sign * fault.size) * way)
    assert fault.size == pytest.approx(max(least.margins * LEAST_GAIN, least.halves * fault.half))
    rate = np.gradient(way, healthy.t_s)
    alone = half_width(healthy, truth.joint, way, nuisance=[rate])
    assert fault.half == pytest.approx(np.hypot(alone, SCATTERS * healthy.scatter[0]))


def test_a_lag_is_a_delay():
    healthy, fault = planted("lag", 1)
    (truth,) = fault.joints
    late = fault.changes[0].position
    shift = np.interp(healthy.t_s - fault.size, healthy.t_s, healthy.way[:, truth.joint])
    settled = healthy.t_s > healthy.motion.period_s
    bend = np.max(np.abs(np.diff(healthy.way[:, truth.joint], 2)))  # of a chord between samples
    assert np.max(np.abs(late - shift)[settled]) <= bend
    assert fault.size >= DEGREE * healthy.motion.period_s / (2 * np.pi)


@pytest.mark.parametrize("name", ["offset", "offset_from", "teeth"])
def test_an_offset_is_constant_where_it_acts(name):
    healthy, fault = planted(name, 1)
    (truth,) = fault.joints
    off = fault.changes[0].position - healthy.way[:, truth.joint]
    acts = healthy.t_s >= (truth.since_s or 0.0)
    np.testing.assert_allclose(off[acts], truth.sign * fault.size, atol=1e-12)
    np.testing.assert_array_equal(off[~acts], 0.0)
    assert fault.size >= max(DEGREE, 3 * fault.half) - 1e-12


def test_a_frozen_encoder_repeats_its_last_value_and_a_jam_its_position():
    healthy, fault = planted("frozen", 1)
    faulty, sound = positions(healthy, fault)
    (truth,) = fault.joints
    first = int(np.argmax(healthy.t_s >= truth.since_s))
    np.testing.assert_array_equal(faulty[first:, truth.joint], sound[first - 1, truth.joint])
    healthy, fault = planted("jammed", 1)
    stays = fault.changes[0].position[healthy.t_s >= fault.joints[0].since_s]
    assert np.ptp(stays) == 0


def test_a_held_joint_stays_for_2_s():
    healthy, fault = planted("held", 1)
    (truth,) = fault.joints
    inside = (healthy.t_s >= truth.since_s) & (healthy.t_s < truth.since_s + 2.0)
    assert np.ptp(fault.changes[0].position[inside]) == 0
    assert inside.sum() * healthy.step_s == pytest.approx(2.0, abs=healthy.step_s)


@pytest.mark.parametrize("name", ["vibration", "vibration_from", "subharmonic"])
def test_a_line_has_its_amplitude(name):
    healthy, fault = planted(name, 2)
    (truth,) = fault.joints
    off = fault.changes[0].position - healthy.way[:, truth.joint]
    acts = healthy.t_s >= (truth.since_s or 0.0)
    assert np.abs(off).max() <= fault.size + 1e-12
    assert off[acts].std() == pytest.approx(fault.size / 2**0.5, rel=0.1)
    assert not off[~acts].any()
    period_s = healthy.motion.period_s
    if name == "subharmonic":
        steps = round(2 * period_s / healthy.step_s)
        assert np.corrcoef(off[steps:], off[:-steps])[0, 1] > 0.9


def test_limits_stop_the_motion():
    healthy, fault = planted("clipped", 2)
    j = fault.joints[0].joint
    assert np.ptp(fault.changes[0].position) < np.ptp(healthy.way[:, j])
    same = np.isclose(fault.changes[0].position, healthy.way[:, j])
    assert 0 < same.mean() < 1
    healthy, fault = planted("rate_limit", 2)
    j = fault.joints[0].joint
    fastest = [np.abs(np.diff(x)).max() for x in (fault.changes[0].position, healthy.way[:, j])]
    assert fastest[0] < 0.9 * fastest[1]


def test_a_dead_joint_gives_no_effort():
    healthy, fault = plant("dead_from", 1, kinds=("efforts",))
    signals = record(healthy, fault.changes, 1)
    (truth,) = fault.joints
    dead = healthy.t_s >= truth.since_s
    effort = np.abs(signals.efforts[:, truth.joint])
    assert effort[dead].mean() < 0.2 * effort[~dead].mean()
    assert truth.allowed == {"dead"}


def test_mirror_pairs_are_at_mirror_places():
    for seed in range(3):
        healthy, fault = planted("mirror_inner", seed)
        first, second = (truth.joint for truth in fault.joints)
        assert first + second == healthy.m - 1
        assert 1 < first < second
        healthy, fault = planted("mirror_ends", seed)
        assert [truth.joint for truth in fault.joints] == [0, healthy.m - 1]
        assert fault.undecidable
        healthy, fault = planted("weak_inner", seed)
        assert 4 <= healthy.m <= 6
        assert 0 < fault.joints[0].joint < healthy.m - 1


def test_hold_keeps_the_value_before():
    acts = np.array([False, False, True, True, False])
    np.testing.assert_array_equal(hold(np.arange(5.0), acts), [0, 1, 1, 1, 4])


def test_a_seed_plants_the_same_again():
    first, second = (plant("gain_from", 6, kinds=BASE) for _ in range(2))
    np.testing.assert_array_equal(*(fault.changes[0].position for _, fault in (first, second)))
    assert draw("white", 6).names == draw("white", 6).names
