"""Warnings are what changes what a reader does, worst first; facts are notes."""

import json

import numpy as np
import pytest

from support.joint_runs import write_joints
from undulog.analysis import analyse_session
from undulog.analysis.common.remarks import Lacking, Note, Remarks

NAMES = tuple(f"j{k}" for k in range(8))


def write(path, *, moving=True):
    """20 s of eight joints that follow 0.5 Hz: positions only."""
    noise = np.random.default_rng(1).normal(0, 1e-3, (2000, len(NAMES)))
    phase = np.pi * 0.01 * np.arange(2000)[:, None] - np.arange(len(NAMES))
    commands, states = 0.4 * np.sin(phase) * moving, [0.38 * np.sin(phase - 0.1) + noise]
    return write_joints(path, NAMES, commands, states, rate_hz=100, session_id="s")


def test_worst_first_and_each_once():
    remarks = Remarks()
    for remark in ("late", Note("no topic"), Lacking("no gait"), "late", Note("no topic")):
        remarks(remark)
    assert remarks.warnings(["cut short"]) == ("no gait", "cut short", "late")
    assert remarks.notes == ("no topic",)
    assert json.dumps([*remarks.warnings(), *remarks.notes]) == '["no gait", "late", "no topic"]'
    assert {type(warning) for warning in (*remarks.warnings(), *remarks.notes)} == {str}


def test_topics_that_were_not_recorded_are_no_warnings(tmp_path, opened):
    analysis = analyse_session(opened(write(tmp_path / "s.mcap")))
    assert analysis.warnings == ()
    for lacking in ("effort and velocity", "/joint_current and no /joint_voltage", "/gait"):
        assert any(lacking in note for note in analysis.notes), lacking
    shown = analysis.to_dict()
    assert (shown["warnings"], shown["notes"]) == ([], list(analysis.notes))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "page"])
def test_notes_stand_after_the_method_or_under_details(kind, tmp_path, command):
    path = write(tmp_path / "s.mcap")
    if kind == "text":
        text = command("analyse", path).out
        assert "Warning:" not in text
        assert text.index("Method:") < text.index("Note: no /joint_current and no /joint_voltage")
        return
    command("report", path, "-o", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert '<div class="notice">' not in page
    assert "<p>No warnings.</p>" in page
    details = page[page.index("notes: what was not recorded") :]
    assert "/joint_current" in details[: details.index("</details>")]


def test_that_there_is_no_gait_comes_first(tmp_path, opened):
    analysis = analyse_session(opened(write(tmp_path / "s.mcap", moving=False)))
    assert analysis.warnings[0].startswith("no gait: the commands never move")
    assert any(note.startswith("no joint's gain and lag are known") for note in analysis.notes)
