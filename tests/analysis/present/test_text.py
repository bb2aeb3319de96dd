"""The terminal text: the answer first, joints that moved, the method last."""

from __future__ import annotations

import math
import re

import pytest

from undulog.analysis.present.text import render


def test_a_pipe_gets_the_answer_first_every_column_and_the_method_last(snake):
    text = render(snake)
    lines = text.splitlines()
    assert lines[0] == f"weak.mcap: {snake.answer.sentence}"
    assert lines[-1].startswith("Method: ")
    heading = next(line for line in lines if line.startswith("joint "))
    assert all(name in heading for name in ("plane", "command°", "gain", "lag°", "cover"))
    assert not [line for line in lines if line.startswith("Without ")]
    for joint in snake.joints:
        rows = [line for line in text.splitlines() if line.startswith(f"{joint.name} ")]
        if joint.gain.value is None:
            assert rows == []
            continue
        gain, lag = re.findall(r"(\S+) \[", rows[0].replace("−", "-"))
        for shown, exact in ((gain, joint.gain.value), (lag, math.degrees(joint.lag_rad.value))):
            assert abs(float(shown) - exact) <= 0.5000001 * 10 ** -len(shown.partition(".")[2])


@pytest.mark.parametrize("width", [80, 100, 200])
def test_nothing_is_wider_than_the_terminal(snake, width):
    lines = render(snake, width=width).splitlines()
    assert max(map(len, lines)) <= width
    assert " ".join(lines).startswith(f"weak.mcap: {snake.answer.sentence}")
    left_out = [line for line in lines if line.startswith("Without ")]
    assert bool(left_out) == (width < 120)
    heading = next(line for line in lines if line.startswith("joint "))
    missing = left_out[0].partition(":")[0].removeprefix("Without ") if left_out else ""
    assert not [name for name in missing.split(", ") if name and name in heading]


def test_nulls_are_dashes_and_every_joint_stays_when_none_was_driven(still):
    text = render(still)
    assert "No gait was found" in text.splitlines()[0]
    for joint in still.joints:
        assert f"\n{joint.name} " in text
    assert "None" not in text
    assert "nan" not in text


def test_names_from_a_log_are_not_markup(hostile):
    assert "<script>" in render(hostile)
