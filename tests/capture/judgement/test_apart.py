"""Joints that respond unlike all others: arms whose joints are of several kinds, in closed form."""

import numpy as np
import pytest

from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples

T_S = np.arange(0.0, 40.0, 0.02)
GAIN, LAG_S = np.array([1.0, 0.9, 0.95, 1.0, 0.97]), np.array([0.10, 0.13, 0.11, 0.12, 0.10])


def arm(gain=GAIN, lag_s=LAG_S, noise=1e-3):
    """Joints that carry out sums of two sines of their own, late and by a gain."""
    rng = np.random.default_rng(5)
    frequency = np.array([0.21, 0.26, 0.31, 0.37, 0.41])

    def wave(t_s, k):
        slow = 0.5 * np.sin(2 * np.pi * frequency[k] * t_s)
        return slow + 0.2 * np.sin(2 * np.pi * 2.3 * frequency[k] * t_s + k)

    return [
        RecordedJoint(
            f"j{k}",
            Samples(T_S, wave(T_S, k)),
            Samples(T_S, gain[k] * wave(T_S - lag_s[k], k) + rng.normal(0, noise, T_S.size)),
        )
        for k in range(5)
    ]


def test_joints_within_the_spread_of_their_kinds_are_not_named():
    assert judge(arm()).apart == ()


@pytest.mark.parametrize("joint", range(5))
def test_a_late_joint_is_named_with_its_lag_and_those_of_the_others(joint):
    lag_s = LAG_S.copy()
    lag_s[joint] += 0.1
    (apart,) = judge(arm(lag_s=lag_s)).apart
    assert (apart.joint, apart.quantity) == (f"j{joint}", "lag")
    assert apart.value == pytest.approx(lag_s[joint], abs=0.01)
    others = np.delete(LAG_S, joint)
    assert others.min() - 2e-3 < apart.others[0] <= apart.others[1] < others.max() + 2e-3
    assert apart.text.startswith(f"lags by {apart.value:.2g} s, the others by 0.1")


def test_a_weak_joint_is_named_with_its_gain():
    gain = GAIN.copy()
    gain[2] = 0.5
    (apart,) = judge(arm(gain=gain)).apart
    assert (apart.joint, apart.quantity) == ("j2", "gain")
    assert apart.value == pytest.approx(0.5, abs=0.01)


def test_two_late_joints_are_both_apart_and_of_three_the_others():
    apart = judge(arm(lag_s=LAG_S + 0.1 * np.array([0, 0, 1, 0, 1]))).apart
    assert [joint.joint for joint in apart] == ["j2", "j4"]
    apart = judge(arm(lag_s=LAG_S + 0.1 * np.array([0, 1, 1, 0, 1]))).apart
    assert [joint.joint for joint in apart] == ["j0", "j3"]


def test_three_joints_are_too_few():
    lag_s = LAG_S + 0.1 * np.array([0, 0, 1, 0, 0])
    assert judge(arm(lag_s=lag_s)[:3]).apart == ()
