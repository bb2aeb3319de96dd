"""The page of benchmarks: complete, in line with its figures, and its intervals right."""

import json

import numpy as np
import pytest
from all import BENCHES, DATA, PAGE, missing
from benchmarks_page import page_of
from measuring import HERE
from records import RECORDS, compared, not_run, ratio_of, verdict
from scipy.stats import ttest_1samp


def test_every_script_with_a_command_line_is_a_bench():
    scripts = {path.stem for path in HERE.glob("*.py") if "__main__" in path.read_text()}
    helpers = {"all", "bus_sender", "peer_recorder", "foreign_reader"}
    assert {bench.script for bench in BENCHES.values()} == scripts - helpers


def test_the_page_shows_the_committed_figures():
    data = json.loads(DATA.read_text())
    assert PAGE.read_text() == page_of(data, missing(data))


def test_interval_of_a_ratio():
    rng = np.random.default_rng(1)
    theirs = rng.uniform(1, 2, 7)
    ours = theirs * np.exp(rng.normal(-1, 0.2, 7))
    expected = ttest_1samp(np.log(ours / theirs), 0).confidence_interval(0.95)
    ratio, low, high = ratio_of(ours, theirs)
    assert (low, high) == pytest.approx((np.exp(expected.low), np.exp(expected.high)))
    assert low < ratio < high
    assert ratio_of([2.0], [4.0]) == (0.5, None, None)


def test_figures_are_collected_and_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(RECORDS, str(tmp_path / "rows.jsonl"))
    assert compared("read", [1.0, 1.0], [4.0, 4.0], "peer 1.0", bar=0.5)
    assert not compared("write", [3.0], [1.0], "peer 1.0", bar=2.0, scale=1.0)
    assert not verdict("frames lost", 1, 0, "frames")
    assert verdict("runs", 3.0, None, "1/s")
    not_run("on a GPU", "no GPU")
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [row["met"] for row in rows] == [True, False, False, None, None]
    conditions = {"quick": False, "command": "python a|b.py", "date": "2026-01-31T12:00+00:00"}
    conditions |= {"load": 0.5, "took_s": 3.2, "exit": 1, "machine": "a machine", "versions": "-"}
    page = page_of({"some": conditions | {"rows": rows}})
    assert "| some | read | 1 s | peer 1.0: 4 s | 0.25 (0.25 to 0.25) | at most 0.5 | yes |" in page
    assert "| some | frames lost |  |  | 1 frames | at most 0 frames | **no** |" in page
    assert "| some | on a GPU |  |  | not run: no GPU |  |  |" in page
    assert "FAIL  frames lost: 1 frames (bar: at most 0 frames)" in capsys.readouterr().out
