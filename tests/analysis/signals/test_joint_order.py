"""Joints whose names a program has sorted as text are taken in the order of their numbers."""

import numpy as np
import pytest

from support.analysed import analysed
from support.written_topics import EPOCH_NS, write_topics
from undulog.analysis.signals.columns import by_number


def ordered(names):
    notes = []
    return list(by_number(tuple(names), notes.append)), notes


def test_numbers_order_what_was_sorted_as_text():
    names = [f"joint_{k}" for k in range(1, 13)]
    order, (note,) = ordered(sorted(names))
    assert order == names
    assert "order of their numbers: joint_1, joint_2" in note
    two = [f"{side}_{k}" for side in ("left", "right") for k in range(12)]
    assert ordered(sorted(two))[0] == two


@pytest.mark.parametrize(
    "names",
    [
        ["joint_1", "joint_2", "joint_10"],  # in order
        ["joint_10", "joint_2", "joint_1"],  # from the tail on, nobody's sorting
        ["hip", "knee", "ankle"],
        ["j09", "j10", "j11"],
    ],
)
def test_any_other_order_is_the_files(names):
    assert ordered(names) == (names, [])


def test_a_wave_runs_along_the_numbers(tmp_path):
    t = np.arange(0.0, 12.0, 0.02)
    names = sorted(f"v_{k}" for k in range(1, 13))
    number = np.array([int(name[2:]) for name in names])
    angles = 0.3 * np.sin(2 * np.pi * 0.8 * t[:, None] - 0.5 * number)
    stamps = EPOCH_NS + np.rint(t * 1e9).astype(np.int64)
    path = write_topics(tmp_path / "a.mcap", stamps, {"/joint_states": (names, "rad", angles)})
    result = analysed(path)
    (wave,) = result.free_motion.waves
    assert wave.joints == tuple(f"v_{k}" for k in range(1, 13))
    assert wave.wave_number.value == pytest.approx(0.5, abs=1e-3)
    assert wave.direction == "first-to-last"
