"""The fault campaign with a fixed seed; every case that once failed, again."""

import os
import sys
from pathlib import Path

import pytest

from campaign.fuzz import Case, run_case
from support.paths import ROOT
from support.processes import run

KEPT = sorted((Path(__file__).parent / "kept").glob("*.json"))


@pytest.mark.slow
def test_the_short_campaign_finds_nothing(tmp_path):
    paths = os.pathsep.join(str(ROOT / folder) for folder in (".", "tests", "bench"))
    env = os.environ | {"PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"}
    words = (sys.executable, "-m", "campaign.run", "--short", "--seed", 1, "-o", tmp_path / "out")
    done = run(*words, cwd=ROOT, env=env, timeout=1200)
    bad = [line for line in done.stdout.splitlines() if not line.endswith(" ok")]
    assert done.returncode == 0, "\n".join(bad)[-6000:] + done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_a_case_that_failed_once(path, tmp_path):
    folder = tmp_path / "w"
    folder.mkdir()
    failures, _ = run_case(Case.from_json(path.read_text()), folder)
    assert failures == []


def test_a_case_comes_back_from_its_file():
    case = Case(("log", "info", "x.mcap"), {"x.mcap": bytes(range(256))}, 1.0)
    assert Case.from_json(case.as_json()) == case
