"""Episodes of simulated data sets, with faults whose truth is known, and pieces of a real one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from support.paths import SHARED
from undulog.analysis.parts.episodes.measure import measure_episodes
from undulog.analysis.parts.episodes.record import Record
from zoo.data_sets import (
    DELAY,
    DROPPED,
    GAIN,
    KINDS,
    OFFSET,
    RATE,
    Fault,
    draw,
    draw_robot,
    simulate,
)

G1 = SHARED / "g1_lerobot_v21"
FEW, MANY = 2, 40
"""Data sets of a kind, here and at night; 5 kinds of 40 are 200."""


def joined(actions, states, fps, names=None, stamps_s=None):
    """Return episodes as a record."""
    lengths = [len(action) for action in actions]
    names = names or tuple(f"j{k}" for k in range(actions[0].shape[1]))
    return Record(
        names, fps, np.arange(len(lengths)), np.concatenate([[0], np.cumsum(lengths)]),
        np.concatenate(actions), np.concatenate(states),
        np.concatenate([np.arange(n) for n in lengths]), stamps_s,
    )  # fmt: skip


def judged(data):
    """Return what is wrong with a simulated data set."""
    return measure_episodes(joined(data.actions, data.states, data.robot.fps), "simulated").faults


def is_named(data):
    """Return whether the worst of what is named is what was planted."""
    faults, fault = judged(data), data.fault
    joint = None if fault.joint is None else f"j{fault.joint}"
    return bool(faults) and (faults[0].episode, faults[0].kind, faults[0].joint) == (
        fault.episode, fault.kind, joint,
    )  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_planted_fault_is_named(kind):
    assert [is_named(draw(seed, kind, most=20)) for seed in range(FEW)] == [True] * FEW


def test_sound_episodes_have_none():
    assert not [fault for seed in range(2 * FEW) for fault in judged(draw(seed, most=20))]


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_planted_faults_are_named_in_19_of_20(kind):
    count = sum(is_named(draw(1000 + seed, kind)) for seed in range(MANY))
    assert count >= binom.ppf(0.01, MANY, 0.95)


@pytest.mark.nightly
def test_sound_data_sets_have_names_in_one_of_20_at_most():
    count = sum(bool(judged(draw(1000 + seed))) for seed in range(5 * MANY))
    assert count <= 0.05 * 5 * MANY


@pytest.fixture(scope="module")
def arm():
    """Return a generator and an arm that follows well."""
    rng = np.random.default_rng(7)
    robot = draw_robot(rng)
    while robot.motion != "pick" or robot.joints > 6:
        robot = draw_robot(rng)
    return rng, robot


def test_sizes_are_those_planted(arm):
    rng, robot = arm
    for kind, size, expected in (
        (OFFSET, np.radians(5), np.radians(5)), (GAIN, 0.75, 0.75), (DELAY, 0.1, 0.1),
    ):  # fmt: skip
        form = "middle" if kind == GAIN else ""
        (worst, *_) = judged(simulate(rng, robot, 12, Fault(kind, 4, 2, form, size)))
        assert (worst.episode, worst.kind, worst.joint) == (4, kind, "j2")
        assert worst.size == pytest.approx(expected, rel=0.06)
        low, high = worst.ci95
        assert low < worst.size < high


def test_a_rate_is_a_factor_of_the_others(arm):
    rng, robot = arm
    (worst, *_) = judged(simulate(rng, robot, 15, Fault(RATE, 3, None, "", -0.25)))
    assert (worst.episode, worst.kind) == (3, RATE)
    # Ticks are 0.75 times as long: the same lag has 1 / 0.75 times as many.
    assert worst.size == pytest.approx(1 / 0.75, abs=0.08)


def test_lost_frames_are_counted_and_placed(arm):
    rng, robot = arm
    data = simulate(rng, robot, 12)
    speed = np.abs(np.diff(data.states[5], axis=0)).sum(axis=1)
    after = 20 + int(speed[20:-20].argmax())
    lost = np.arange(after, after + 4)
    data.actions[5], data.states[5] = (
        np.delete(values[5], lost, axis=0) for values in (data.actions, data.states)
    )
    (worst, *_) = judged(data)
    assert (worst.episode, worst.kind) == (5, DROPPED)
    assert worst.size == pytest.approx(4, abs=2)  # the speed is another in between
    assert worst.at_s == pytest.approx(after / robot.fps, abs=2.5 / robot.fps)


def test_copies_of_a_frame_are_named(arm):
    rng, robot = arm
    data = simulate(rng, replace(robot, noise_rad=1e-3), 12)
    speed = np.abs(np.diff(data.states[5], axis=0)).sum(axis=1)
    twice = 20 + int(speed[20:-20].argmax())
    data.actions[5], data.states[5] = (
        np.insert(values[5], twice, values[5][twice], axis=0)
        for values in (data.actions, data.states)
    )
    assert [(fault.episode, fault.kind) for fault in judged(data)] == [(5, "doubled")]


def test_what_stands_is_named(arm):
    rng, robot = arm
    data = simulate(rng, robot, 12)
    data.states[2][:, 1] = data.states[2][0, 1]
    data.states[6][:] = data.states[6][0]
    data.actions[8][:], data.states[8][:] = data.actions[8][0], data.states[8][0]
    data.states[9][10, 0] = np.nan
    named = {(fault.episode, fault.kind, fault.joint) for fault in judged(data)}
    assert named >= {
        (2, "frozen", "j1"), (6, "stand-still", None), (8, "stand-still", None),
        (9, "missing", None),
    }  # fmt: skip
    assert {episode for episode, *_ in named} == {2, 6, 8, 9}


def test_a_signal_in_degrees_is_scaled(arm):
    rng, robot = arm
    data = simulate(rng, robot, 12)
    data.states[2][:, 1] = np.degrees(data.states[2][:, 1])
    (worst, *_) = judged(data)
    assert (worst.episode, worst.kind, worst.joint) == (2, "gain", "j1")
    assert "scaled" in worst.sentence
    assert worst.size == pytest.approx(180 / np.pi, rel=0.1)


def test_numbers_and_stamps_show_what_is_missing(arm):
    rng, robot = arm
    data = simulate(rng, robot, 6)
    record = joined(data.actions, data.states, robot.fps)
    frame = record.frame.copy()
    frame[record.starts[2] + 30 : record.starts[3]] += 7
    stamps_s = record.frame / robot.fps
    stamps_s[record.starts[4] : record.starts[5]] *= 1.1
    faults = measure_episodes(replace(record, frame=frame, stamps_s=stamps_s), "x").faults
    shown = [(fault.episode, fault.kind, fault.size) for fault in faults if fault.times is None]
    assert shown == [(2, "dropped", 7.0), (4, "rate", pytest.approx(1 / 1.1))]


def test_two_groups_of_episodes_are_no_faults(arm):
    """Episodes of another task may rest otherwise; which of them is right isn't known."""
    rng, robot = arm
    data = simulate(rng, robot, 20)
    for state in data.states[14:]:
        state[:, 3] += np.radians(6)
    result = measure_episodes(joined(data.actions, data.states, robot.fps), "x")
    assert not result.faults
    assert any("offset of j3: 6 of 20 episodes differ" in limit for limit in result.limits)


def test_few_episodes_are_not_judged(arm):
    rng, robot = arm
    data = simulate(rng, robot, 5)
    data.actions[1:3], data.states[1:3] = (
        [values[1][:10], values[2][:10]] for values in (data.actions, data.states)
    )
    result = measure_episodes(joined(data.actions, data.states, robot.fps), "x")
    assert not result.faults
    assert [*result.not_judged] == ["1", "2"]
    assert any("3 episodes are too few" in limit for limit in result.limits)


@pytest.mark.skipif(not G1.exists(), reason=f"the G1 data are not at {G1}")
def test_pieces_of_a_real_humanoid():
    """Half-minutes of a person's work in 3 s pieces; frames and gains are taken from them."""
    from undulog.capture.exchange.formats.lerobot.frames import read_frames
    from undulog.capture.exchange.formats.lerobot.importing import open_lerobot

    frames = read_frames(open_lerobot(G1))
    starts = [
        start
        for first, stop in zip(frames.starts, frames.starts[1:], strict=False)
        for start in range(first, stop - 90, 90)
    ]

    def cut(values):
        arms = slice(0, 14)  # the hands hold an object in some of the pieces
        return [values[start : start + 90, arms].copy() for start in starts]

    def worst(actions, states):
        result = measure_episodes(joined(actions, states, 30.0, frames.names[:14]), "g1")
        return [(fault.episode, fault.kind, fault.joint) for fault in result.faults]

    actions, states = cut(frames.commands), cut(frames.states)
    states[5][:, 13] = states[5][:, 13].mean() + 0.75 * (states[5][:, 13] - states[5][:, 13].mean())
    assert (5, "gain", "kRightWristYaw") in worst(actions, states)
    actions, states = cut(frames.commands), cut(frames.states)
    actions[3], states[3] = (
        np.delete(values[3], np.arange(45, 50), axis=0) for values in (actions, states)
    )
    assert (3, "dropped", None) in worst(actions, states)
