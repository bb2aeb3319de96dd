"""The main job end to end, on the files that `make demo` makes, held by foreign tools."""

import json
import os
import re
import sys
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from support import processes
from support.paths import ROOT

RERUN = Path(sys.executable).parent / "rerun"
JOINTS = [f"joint{i:02d}" for i in range(1, 26)]

pytestmark = pytest.mark.slow


MADE = "UNDULOG_DEMO"
"""Environment variable: a folder below the root in which `make demo` of this tree has just been."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """What `make demo` has made, or makes: the folder."""
    if made := os.environ.get(MADE):
        return ROOT / made
    folder = tmp_path_factory.mktemp("demo")
    recipe = re.findall(r"\$\(call undulog,(.*)\)\n", (ROOT / "Makefile").read_text())
    assert len(recipe) == 4
    for line in recipe:
        run(sys.executable, "-m", "undulog", *line.replace("$(DEMO)", str(folder)).split())
    return folder


def run(*command):
    return processes.run(*[str(word) for word in command], code=0).stdout


def test_rosbags_reads_every_message(demo):
    with AnyReader([demo / "session.mcap"]) as reader:
        counts = dict.fromkeys((connection.topic for connection in reader.connections), 0)
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            counts[connection.topic] += 1
            if connection.topic == "/joint_states":
                assert list(message.name) == JOINTS
    assert counts["/joint_states"] == counts["/joint_commands"] == 2001
    assert counts["/odom"] == 2001


def test_rerun_shows_the_named_joints_of_the_session(demo):
    run(RERUN, "mcap", "convert", demo / "session.mcap", "-o", demo / "native.rrd")
    run(RERUN, "rrd", "verify", demo / "native.rrd")
    where = ("--entity", "/joint_states/position")
    printed = run(RERUN, "rrd", "print", "-vvv", *where, demo / "native.rrd")
    assert ", ".join(JOINTS[:10]) in printed  # it cuts long lists short


def test_the_replay_file_verifies(demo):
    run(RERUN, "rrd", "verify", demo / "replay.rrd")


def test_the_result_has_the_papers_claim_with_an_interval(demo):
    result = json.loads((demo / "result.json").read_text())
    contrast = result["heterogeneity"]["boundary_contrast_lag"]
    degrees = [-57.29577951308232 * value for value in (contrast["value"], *contrast["ci95"])]
    assert 5 < degrees[2] <= degrees[0] <= degrees[1] < 10
    assert [joint["name"] for joint in result["joints"]] == JOINTS


def test_the_page_opens_silently(demo, browser):
    browser.open((demo / "report.html").as_uri())
    assert browser.complaints() == []
    assert [url for url in browser.requests() if not url.endswith("report.html")] == []
