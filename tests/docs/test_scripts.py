"""Every study runs: each has --quick, few draws and short runs, for this test."""

import os
import sys

import pytest

from support.paths import DOCS, ROOT, STUDIES
from support.processes import run

OWN_TESTS = {"paper_figures.py", "oscillator_tables.py", "pictures.py", "real_robots.py"}
TABLES = sorted({path.name for path in STUDIES.glob("*.py")} - OWN_TESTS)

pytestmark = [pytest.mark.slow, pytest.mark.built("scripts")]


def printed(*words):
    """What a script prints; it has to end well, with warnings as errors."""
    threads = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = run(*[sys.executable, "-W", "error", *map(str, words)], env=os.environ | threads, code=0)
    return done.stdout


@pytest.mark.parametrize("name", TABLES)
def test_tables_are_printed(name):
    lines = printed(STUDIES / name, "--quick").splitlines()
    assert len(lines) > 3
    assert any(character.isdigit() for character in lines[-1])


def test_the_oscillator_table_predicts_the_closed_loop():
    """Three yaw joints are few, but the closed loop has gone where P and R say."""
    text = printed(STUDIES / "oscillator_tables.py", "--quick")
    labels = ("moved by", "off by")
    moved, off = (float(text.partition(label)[2].partition("%")[0]) for label in labels)
    assert 0 < off < moved


def test_the_figures_of_the_paper_are_drawn(tmp_path):
    printed(STUDIES / "paper_figures.py", tmp_path / "sessions", tmp_path / "images", "--quick")
    assert names(tmp_path / "images") == {path.name for path in DOCS.glob("images/paper-*.svg")}


def test_the_pictures_of_the_manual_are_drawn(tmp_path, vulkan, command):
    session, result, page = (tmp_path / f for f in ("session.mcap", "result.json", "report.html"))
    words = ("--duration", "14.5", "--kernels", "numba", "-o", session)
    command("sim", "run", "weak-servo-pi3", *words)
    command("analyse", session, "-o", result)
    command("report", session, "-o", page)
    images = tmp_path / "images"
    printed(STUDIES / "pictures.py", tmp_path, images, "--quick")
    drawn = {"clip.gif", "replay-mean-cycle.png", "response.svg", "side-by-side.png"}
    assert names(images) == drawn <= names(DOCS / "images")


def names(folder):
    return {path.name for path in folder.iterdir()}
