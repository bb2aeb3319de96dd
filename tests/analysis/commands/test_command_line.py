"""What the commands of the analysis refuse before they work, and what they say of a bad file."""

import json
import re

import numpy as np
import pytest

from support.joint_runs import write_joints

NAMES = ("j1", "j2", "j3")


def written(path, *, states=True, lost=()):
    """A gait of 1 Hz whose responses at some samples are not numbers."""
    noise = np.random.default_rng(5).normal(0, 1e-3, (300, 3))
    phase = 2 * np.pi * np.arange(300)[:, None] / 50 - np.arange(3)
    angle = 0.38 * np.sin(phase - 0.2) + noise
    angle[list(lost)] = np.nan
    return write_joints(path, NAMES, 0.4 * np.sin(phase), [angle] if states else [])


@pytest.fixture
def good(tmp_path):
    return written(tmp_path / "good.mcap")


@pytest.mark.parametrize("verb", ["analyse", "report", "compare"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "-1"], "--start -1 is before the session's start"),
        (["--start", "5", "--stop", "3"], "--stop 3 is not after --start 5"),
        (["--stop", "0"], "--stop 0 is not after --start 0"),
        (["-o", "x.odt"], "x.odt: "),
        (["-o", "nowhere/x.html"], "nowhere/x."),
    ],
)
def test_wrong_usage_is_refused_before_the_work(verb, options, message, command):
    if verb == "analyse":
        options = [word.replace(".html", ".json") for word in options]
    page = ["-o", "x.html"] if verb == "report" and "-o" not in options else []
    files = ["a.mcap", "b.mcap"]  # not there: nothing was opened
    out, err = command(verb, *files, *options, *page, code=2)
    assert out == ""
    assert err.startswith(f"error: {message}")


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["analyse", "report", "compare"])
def test_a_bad_file_is_named_and_leaves_nothing_behind(verb, good, tmp_path, command):
    page = tmp_path / "out.html"
    output = [] if verb == "analyse" else ["-o", page]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(good.read_bytes()[:1500])
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    for bad, why in (
        (tmp_path / "missing.mcap", "no such file"),
        (text, "not an MCAP file"),
        (cut, "without any channel that could be read"),
    ):
        out, err = command(verb, good, bad, *output, code=1)
        assert out == "" or verb == "analyse"  # which prints a line for each file
        assert re.match(rf"error: {re.escape(str(bad))}: .*{why}", err)
        assert not page.exists()


def test_a_topic_that_was_chosen_must_be_there(good, command):
    err = command("analyse", good, "--command-topic", "/foo", code=1).err
    there = "it has /joint_commands, /joint_states"
    how = "(choose with --command-topic and --response-topic)"
    assert err == f"error: {good}: has no /foo; {there} {how}\n"


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ({"states": False}, "No positions on /joint_states: gain and lag are null."),
        ({"lost": range(300)}, "Too few response samples for j1, j2, j3: gain and lag are null."),
    ],
)
def test_no_answer_says_what_is_lacking(kind, why, tmp_path, command):
    out = command("analyse", written(tmp_path / "lacking.mcap", **kind)).out
    assert out.splitlines()[1] == why


def test_a_sample_that_is_no_number_is_flagged_and_json_stays_json(tmp_path, command):
    out = command("analyse", written(tmp_path / "nan.mcap", lost=(200,)), "--json").out

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    result = json.loads(out, parse_constant=refuse)
    assert all("nan" in joint["flags"] for joint in result["joints"])
    assert all(abs(joint["gain"] - 0.95) < 0.01 for joint in result["joints"])
