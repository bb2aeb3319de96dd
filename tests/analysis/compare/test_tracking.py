"""Offsets between sessions, and joints whose commands are no gait: against planted truth."""

import numpy as np
import pytest

from support.written_topics import EPOCH_NS, write_topics
from undulog.analysis import compare_sessions
from undulog.analysis.compare.quantities import Quantities, independent
from undulog.analysis.compare.tracking import (
    MeanCommand,
    at_one_command,
    commands_differ,
    mean_commands,
    tracking_estimates,
)
from undulog.analysis.estimators.intervals import holm
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.tracking.measure import track_joints
from undulog.capture import Session
from undulog.capture.common.errors import DataError

NAMES = [f"j{k}" for k in range(1, 7)]
DEGREE = np.pi / 180
TONES = 0.1 * np.array([1, 2, 3, 5, 7, 11])
GAINS = np.array([0.98, 0.95, 0.9, 1.0, 0.97, 0.93])  # unlike joints
LAGS_S = np.array([0.05, 0.09, 0.12, 0.06, 0.15, 0.08])
OFFSETS = np.array([0.5, -2.0, 1.0, 0.0, 3.0, -1.0]) * DEGREE


def work(rng, middle=0.0):
    """Return commands of six joints that each have phases of their own [rad]."""
    phases = rng.uniform(0, 2 * np.pi, (TONES.size, len(NAMES)))

    def command(t_s):
        waves = zip(TONES, phases, strict=True)
        return middle + sum(0.12 * np.sin(2 * np.pi * tone * t_s + phase) for tone, phase in waves)

    return command


def gait(_rng, middle=0.0):
    phases = np.arange(len(NAMES)) * 0.7
    return lambda t_s: middle + 0.4 * np.sin(2 * np.pi * 0.5 * t_s + phases)


def write(path, seed, *, motion=work, middle=0.0, changes=None, serial=""):
    """Write a session; changes are of gain (a factor) and offset [rad], by joint."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 30.0, 0.02)
    command = motion(rng, middle)
    gains, offsets = GAINS.copy(), OFFSETS.copy()
    for joint, (factor, offset) in (changes or {}).items():
        gains[NAMES.index(joint)] *= factor
        offsets[NAMES.index(joint)] += offset
    asked, late = command(t[:, None]), command(t[:, None] - LAGS_S)
    given = gains * late + offsets + 0.003 * rng.standard_normal(asked.shape)
    topics = {"/joint_commands": (NAMES, "rad", asked), "/joint_states": (NAMES, "rad", given)}
    about = {"metadata": {"serial": serial}} if serial else {}
    return write_topics(path, EPOCH_NS + np.rint(t * 1e9).astype(np.int64), topics, **about)


def compared(a, b):
    with Session.open(a) as first, Session.open(b) as second:
        return compare_sessions(first, second)


def by_key(comparison):
    return {
        (difference.quantity, difference.place): difference.difference
        for difference in comparison.differences
    }


def test_an_offset_that_moved_and_a_gain_that_fell_are_stated_with_their_intervals(tmp_path):
    changes = {"j4": (1.0, 5.1 * DEGREE), "j2": (0.8, 0.0)}
    a, b = write(tmp_path / "a.mcap", 1), write(tmp_path / "b.mcap", 2, changes=changes)
    result = compared(a, b)
    assert result.verdict == "different"
    assert "the offset of j4 moved by +5.1" in result.answer
    assert "j2 most, gain −2" in result.answer
    differences = by_key(result)
    low, high = differences["offset", "j4"].ci95
    assert low < 5.1 * DEGREE < high < low + 0.5 * DEGREE
    low, high = differences["gain", "j2"].ci95
    assert low < -0.2 < high
    assert [joint.name for joint in result.named] == ["j2"]
    assert any("not how one run differs from the next" in text for text in result.warnings)


def test_joints_that_did_not_change_do_not_differ_with_other_commands(tmp_path):
    """Whether a servo holds a command until the next is open, and 20 ms of the lag with it."""
    result = compared(write(tmp_path / "a.mcap", 3), write(tmp_path / "b.mcap", 4))
    assert result.verdict in ("same", "open"), result.answer
    shown = {row.quantity for row in result.equivalence if row.p < 0.05}
    assert {"gain", "offset"} <= shown


def test_an_offset_belongs_to_its_command(tmp_path):
    """A joint that gives 90 % stands 2 degrees further off where its command is 20 degrees more."""
    a, b = write(tmp_path / "a.mcap", 3), write(tmp_path / "b.mcap", 4, middle=20 * DEGREE)
    differences = by_key(compared(a, b))
    assert abs(differences["offset", "j3"].value) < 0.2 * DEGREE
    estimates = [{("offset", "j"): (0.0, 1e-6, 9.0)}, {("offset", "j"): (-0.04, 1e-6, 9.0)}]
    commands = [{"j": MeanCommand(0.0, -0.1, 1e-4)}, {"j": MeanCommand(0.4, -0.1, 1e-4)}]
    first, second = at_one_command(estimates, commands)
    assert first["offset", "j"][0] == pytest.approx(-0.02)
    assert second["offset", "j"][0] == pytest.approx(-0.02)
    assert first["offset", "j"][1] == pytest.approx(1e-6 + 1e-4 * 0.04)
    of_gaits = [{"j": MeanCommand(0.0)}, {"j": MeanCommand(0.4)}]
    assert at_one_command(estimates, of_gaits) == [{}, {}]


def test_the_offset_of_a_gait_moves_too(tmp_path):
    changes = {"j4": (1.0, 5.1 * DEGREE)}
    a = write(tmp_path / "a.mcap", 1, motion=gait)
    b = write(tmp_path / "b.mcap", 2, motion=gait, changes=changes)
    result = compared(a, b)
    assert "the offset of j4 moved by +5.1" in result.answer
    low, high = by_key(result)["offset", "j4"].ci95
    assert low < 5.1 * DEGREE < high < low + 0.5 * DEGREE


def test_of_two_robots_an_offset_differs(tmp_path):
    changes = {"j4": (1.0, 5.1 * DEGREE)}
    a = write(tmp_path / "a.mcap", 1, serial="SN1")
    b = write(tmp_path / "b.mcap", 2, changes=changes, serial="SN2")
    assert "the offset of j4 differs by +5.1" in compared(a, b).answer


def test_a_gait_is_not_compared_with_other_motion(tmp_path):
    a, b = write(tmp_path / "a.mcap", 1, motion=gait), write(tmp_path / "b.mcap", 2)
    with pytest.raises(DataError, match=r"b\.mcap has no gait"):
        compared(a, b)


def tracked(command, rng, rho=0.8):
    """Track six joints for 16 s whose noise is correlated from sample to sample."""
    t = np.arange(0.0, 16.0, 0.02)
    noise = rng.standard_normal((t.size, len(NAMES)))
    for k in range(1, t.size):
        noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * noise[k]
    given = GAINS * command(t[:, None] - LAGS_S) + OFFSETS + 0.01 * noise
    asked = command(t[:, None])
    columns = [
        {name: Series(name, t, values[:, k]) for k, name in enumerate(NAMES)}
        for values in (asked, given)
    ]
    return track_joints(*columns, []).joints


@pytest.mark.slow
def test_of_sessions_in_which_nothing_differs_one_in_twenty_states_a_difference():
    """40 pairs at 5 %: at most 6 (99 % of a binomial distribution)."""
    rng, false = np.random.default_rng(5), 0
    for _ in range(40):
        joints = [tracked(work(rng), rng) for _ in range(2)]
        estimates = [tracking_estimates(joint) for joint in joints]
        sides = at_one_command(estimates, [mean_commands({}, joint) for joint in joints])
        keys = list(sides[0])
        first, second = (Quantities(*np.array([side[k] for k in keys]).T) for side in sides)
        false += float(holm(independent(first, second).p).min()) < 0.05
    assert false <= 6


def test_commands_of_another_range_or_pace_are_stated():
    rng = np.random.default_rng(6)
    joints = tracked(work(rng), rng)
    slow = work(rng)
    paced = tracked(lambda t_s: slow(t_s / 2), rng)
    assert commands_differ([joints], [joints], NAMES) is None
    text = commands_differ([joints], [paced], NAMES)
    assert text.startswith("the commands of j1, j2, j3, j4 and 2 more differ: that of j1 ranges")
