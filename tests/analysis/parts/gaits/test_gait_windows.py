"""Sessions whose gait changes: windows, responses and the comparison against their closed forms."""

import numpy as np
import pytest

from support.analysed import analysed
from support.written_topics import EPOCH_NS, write_topics

NAMES = [f"j{k}" for k in range(8)]
RATE_HZ = 100.0
LAG_S = 0.06


class Motion:
    """Commands whose pace, amplitude, direction and offset are functions of time."""

    def __init__(self, t_s, pace_hz=0.6, amplitude=0.4, step=-0.8, offset=0.0):
        fine = np.arange(-1.0, t_s[-1] + 1.0, 1e-3)
        ones = np.ones_like(fine)
        self.fine = fine
        self.phase = 2 * np.pi * np.cumsum(ones * at(pace_hz, fine)) * 1e-3
        self.amplitude, self.step, self.offset = (
            ones * at(value, fine) for value in (amplitude, step, offset)
        )

    def command(self, t_s, joint):
        phase, amplitude, step, offset = (
            np.interp(t_s, self.fine, values)
            for values in (self.phase, self.amplitude, self.step, self.offset)
        )
        return amplitude * np.sin(phase + joint * step) + offset


def at(value, t_s):
    return value(t_s) if callable(value) else value


def stepped(before, after, when):
    return lambda t_s: np.where(t_s < when, before, after)


def write(path, *, gains=None, lags_s=None, noise=0.002, seed=0, duration_s=60.0, **motion):
    """Write a session whose joints follow by a gain and a lag each."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, duration_s, 1 / RATE_HZ)
    moved = Motion(t_s, **motion)
    gains = np.full(8, 0.95) if gains is None else gains
    lags_s = np.full(8, LAG_S) if lags_s is None else lags_s
    asked = np.stack([moved.command(t_s, k) for k in range(8)], axis=1)
    given = np.stack(
        [gains[k] * moved.command(t_s - lags_s[k], k) for k in range(8)], axis=1
    ) + noise * rng.standard_normal(asked.shape)
    topics = {"/joint_commands": (NAMES, "rad", asked), "/joint_states": (NAMES, "rad", given)}
    return write_topics(path, EPOCH_NS + np.rint(t_s * 1e9).astype(np.int64), topics)


CHANGES = {
    "pace": {"pace_hz": stepped(0.5, 0.9, 33.0)},
    "amplitude": {"amplitude": stepped(0.3, 0.45, 33.0)},
    "direction": {"step": stepped(-0.8, 0.8, 33.0)},
    "offset": {"offset": stepped(0.0, 0.15, 33.0)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_each_gait_has_its_window_and_response(tmp_path, change):
    result = analysed(write(tmp_path / "a.mcap", **CHANGES[change]))
    assert len(result.gaits) == 2
    first, second = result.gaits
    assert first.start_s == pytest.approx(0.0, abs=0.1)
    assert first.stop_s == pytest.approx(33.0, abs=0.3)
    assert second.stop_s == pytest.approx(60.0, abs=0.3)
    assert 33.0 < second.start_s < 36.0
    paces = (0.5, 0.9) if change == "pace" else (0.6, 0.6)
    for gait, pace in zip(result.gaits, paces, strict=True):
        assert gait.frequency_hz.value == pytest.approx(pace, rel=2e-3)
        assert [joint.joint for joint in gait.joints] == NAMES
        for joint in gait.joints:
            assert joint.gain.value == pytest.approx(0.95, abs=5e-3)
            assert joint.lag_rad.value == pytest.approx(2 * np.pi * pace * LAG_S, abs=5e-3)
    assert second.wave == ("tail-to-head" if change == "direction" else "head-to-tail")
    assert result.gait.frequency_hz.value == pytest.approx(paces[0], rel=2e-3)
    assert not result.answer.stand_out
    assert not result.answer.not_following


@pytest.mark.parametrize("change", CHANGES)
def test_a_weak_joint_is_named_over_all_gaits(tmp_path, change):
    gains = np.full(8, 0.95)
    gains[3] = 0.55
    answer = analysed(write(tmp_path / "a.mcap", gains=gains, **CHANGES[change])).answer
    assert answer.sentence.startswith("j3 "), answer.sentence
    names = {difference.joint for difference in (*answer.stand_out, *answer.apart)}
    assert names | {fault.joint for fault in answer.not_following} == {"j3"}


def test_a_difference_lost_in_one_gait_is_found_over_all(tmp_path):
    gains = 0.95 * (1 + 0.004 * np.random.default_rng(5).standard_normal(8))
    gains[5] = 0.95 * 1.05
    pace = stepped(0.5, 0.9, 30.0)
    answer = analysed(write(tmp_path / "a.mcap", gains=gains, noise=0.05, pace_hz=pace)).answer
    (difference,) = answer.stand_out
    assert (difference.joint, difference.quantity) == ("j5", "gain")
    assert difference.ci95[0] <= 0.05 <= difference.ci95[1]


@pytest.mark.parametrize(
    "motion",
    [
        {},
        {"amplitude": lambda t_s: 0.4 * np.clip(t_s / 6, 0, 1)},
        {"pace_hz": lambda t_s: 0.6 + 0.0005 * t_s},
        {"pace_hz": lambda t_s: 0.1 * 30 ** (np.clip(t_s, 0, 60) / 60)},
        {"amplitude": lambda t_s: 0.4 * (1 + 0.3 * np.sin(2 * np.pi * t_s / 20))},
    ],
    ids=["one gait", "soft start", "slow drift", "sweep", "modulated"],
)
def test_one_gait_or_none_is_not_divided(tmp_path, motion):
    assert analysed(write(tmp_path / "a.mcap", **motion)).gaits == ()
