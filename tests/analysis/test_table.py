"""The terminal text: the answer first, joints that moved, the method last."""

from __future__ import annotations

import math
import re

from analysis.answer import answer
from analysis.table import render


def test_the_answer_stands_first_and_the_method_last(snake):
    lines = render(snake).splitlines()
    assert lines[0] == f"weak.mcap: {answer(snake).sentence}"
    assert lines[-1].startswith("Method: ")


def test_every_joint_that_was_driven_has_its_numbers(snake):
    text = render(snake)
    for joint in snake.joints:
        rows = [line for line in text.splitlines() if line.startswith(f"{joint.name} ")]
        if joint.gain.value is None:
            assert rows == []
            continue
        gain, lag = re.findall(r"(\S+) \[", rows[0].replace("−", "-"))
        for shown, exact in ((gain, joint.gain.value), (lag, math.degrees(joint.lag_rad.value))):
            decimals = len(shown.partition(".")[2])
            assert abs(float(shown) - exact) <= 0.5000001 * 10**-decimals


def test_tables_fit_a_laptop_terminal_and_prose_wraps(snake):
    assert max(len(line) for line in render(snake, width=100).splitlines()[1:]) <= 120


def test_nulls_are_dashes_and_every_joint_stays_when_none_was_driven(still):
    text = render(still)
    assert "No gait was found" in text.splitlines()[0]
    for joint in still.joints:
        assert f"\n{joint.name} " in text
    assert "None" not in text
    assert "nan" not in text


def test_names_from_a_log_are_not_markup(hostile):
    assert "<script>" in render(hostile)
