"""Only what a joint had to do is judged: amplitudes about the rest error, rests, ranges."""

import re

import numpy as np
import pytest

from undulog.capture.judgement.exposure import covered, window_ranges
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.levels import LARGEST_REST_RAD
from undulog.capture.judgement.motion import RecordedJoint, Samples

T = np.arange(0.0, 30.0, 0.02)


def joints(amplitude_rad, still, noise_rad=0.001):
    rng = np.random.default_rng(4)
    recorded = []
    for k in range(6):
        command = amplitude_rad * np.sin(2 * np.pi * 0.7 * T - 0.5 * k)
        late = amplitude_rad * np.sin(2 * np.pi * 0.7 * (T - 0.05) - 0.5 * k)
        position = (0 if k in still else 1) * late + noise_rad * rng.normal(size=T.size)
        recorded.append(RecordedJoint(f"j{k}", Samples(T, command), Samples(T, position)))
    return recorded


@pytest.mark.parametrize("size", [2, 3, 7, 64, 100])
def test_ranges_of_windows_are_those_of_each_window(size):
    values = np.random.default_rng(size).normal(size=100)
    (ranges,) = window_ranges(values, [size])
    expected = [np.ptp(values[k : k + size]) for k in range(100 - size + 1)]
    np.testing.assert_array_equal(ranges, expected)


def test_windows_cover_their_samples():
    starts = np.array([False, True, False, False, True, False])
    assert covered(starts, 2, 7).tolist() == [False, True, True, False, True, True, False]


def test_a_joint_that_was_hardly_asked_to_move_is_not_judged():
    """By less than what a healthy joint may lose, a dead joint looks like a healthy one."""
    judgement = judge(joints(LARGEST_REST_RAD / 3, still=[2], noise_rad=0.01))
    assert judgement.faults == ()
    names = [name for name, _ in judgement.unexposed]
    assert "j2" in names
    assert dict(judgement.unexposed)["j2"] == pytest.approx(2 * LARGEST_REST_RAD / 3, rel=0.01)


def test_like_joints_show_that_a_small_motion_can_be_followed():
    judgement = judge(joints(LARGEST_REST_RAD / 3, still=[2]))
    assert [fault.joint for fault in judgement.faults] == ["j2"]
    assert judgement.unexposed == ()


def test_an_unlike_joint_is_not_judged_by_a_small_motion():
    alone = joints(LARGEST_REST_RAD / 3, still=[2])[:3]
    judgement = judge(alone)
    assert judgement.faults == ()
    assert [name for name, _ in judgement.unexposed] == ["j0", "j1", "j2"]


def test_a_joint_that_had_to_move_and_stood_is_accused_with_its_evidence():
    (fault,) = judge(joints(4 * LARGEST_REST_RAD, still=[2])).faults
    assert (fault.joint, fault.since_s, fault.share) == ("j2", None, 1.0)
    asked_deg = float(re.search(r"of ([\d.]+) degrees", fault.evidence)[1])
    assert asked_deg == pytest.approx(24.0, abs=0.15)


def test_a_soft_joint_rests_off_and_is_not_accused():
    rng = np.random.default_rng(5)
    motions = []
    for k in range(5):
        moves = (T % 10) < 5
        command = 0.5 * np.sin(2 * np.pi * 0.8 * T - 0.4 * k) * moves
        late = np.interp(T - 0.05, T, command)
        sag = np.radians(6.0) * ~moves * (k == 3)
        position = late - sag + 0.001 * rng.normal(size=T.size)
        motions.append(RecordedJoint(f"j{k}", Samples(T, command), Samples(T, position)))
    judgement = judge(motions)
    assert judgement.faults == ()
    (rest,) = judgement.rests
    assert (rest.joint, rest.offset_rad) == ("j3", pytest.approx(-np.radians(6.0), abs=0.01))


def late_by_half_a_cycle():
    """Joints that stand until their commands reach them, half a cycle late."""
    recorded = []
    for k in range(6):
        phase = 2 * np.pi * 1.2 * T - 0.5 * k
        position = np.where(T < 0.5 / 1.2, np.sin(-0.5 * k), np.sin(phase - np.pi))
        noise = 0.001 * np.random.default_rng(k).normal(size=T.size)
        command = Samples(T, 0.15 * np.sin(phase))
        recorded.append(RecordedJoint(f"j{k}", command, Samples(T, 0.12 * position + noise)))
    return recorded


def test_joints_that_are_late_by_half_a_cycle_do_not_stand_at_the_beginning():
    judgement = judge(late_by_half_a_cycle())
    assert judgement.faults == ()
    assert "or lag by 0.42 s" in judgement.naming
