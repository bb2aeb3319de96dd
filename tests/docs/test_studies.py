"""Every script of studies/ runs in its short form, --quick, and leaves manual and rows alone.

A script that writes files takes -o FOLDER.
"""

import os
import sys

import pytest
from study.conclusions import CONCLUSIONS, evaluate
from study.results import results_of

from support.paths import DOCS, ROOT, SHARED, STUDIES
from support.processes import run

MAIN = 'if __name__ == "__main__":'
SCRIPTS = sorted(
    str(path.relative_to(STUDIES))
    for path in STUDIES.rglob("*.py")
    if path.parent == STUDIES or MAIN in path.read_text()
)
NEEDS_MORE = {"heterogeneity", "load", "long-chains"}
"""Conclusions of the study that its short form leaves open: too few points or lengths of chains."""

pytestmark = pytest.mark.nightly


def shows_the_conclusions_of_the_study(folder, _):
    verdicts = evaluate(results_of(folder / "rows.parquet"))
    assert {verdict.conclusion.name for verdict in verdicts if verdict.holds is None} == NEEDS_MORE
    assert [verdict for verdict in verdicts if verdict.holds is False] == []
    page = (folder / "study.md").read_text()
    for name in (conclusion.name for conclusion in CONCLUSIONS):
        assert f"`{name}`" in page


def predicts_the_closed_loop(_, printed):
    """Three yaw joints are few, but the closed loop has gone where P and R say."""
    labels = ("moved by", "off by")
    moved, off = (float(printed.partition(label)[2].partition("%")[0]) for label in labels)
    assert 0 < off < moved


def draws_the_figures_of_the_paper(folder, _):
    assert names(folder) == {path.name for path in DOCS.glob("images/paper-*.svg")}


def draws_pictures_of_the_manual(folder, _):
    drawn = {"clip.gif", "replay-mean-cycle.png", "response.svg", "side-by-side.png"}
    assert names(folder) == drawn <= names(DOCS / "images")


def draws_figures_of_the_readme(folder, _):
    assert names(folder) == {"sampling-times.svg", "weak-joint.svg"} <= names(DOCS / "images")


def gives_the_numbers_of_the_page(folder, _):
    page = "explanation/real-robots.md"
    assert (folder / page).read_text() == (DOCS / page).read_text()


CHECKS = {
    "oscillator_tables.py": predicts_the_closed_loop,
    "paper_figures.py": draws_the_figures_of_the_paper,
    "pictures.py": draws_pictures_of_the_manual,
    "readme_figures.py": draws_figures_of_the_readme,
    "real_robots.py": gives_the_numbers_of_the_page,
    "study/study.py": shows_the_conclusions_of_the_study,
}


def names(folder):
    return {path.name for path in folder.iterdir()}


def written():
    """When each file of the manual and of the studies was written."""
    files = (path for folder in (DOCS, STUDIES) for path in folder.rglob("*") if path.is_file())
    return {path: path.stat().st_mtime_ns for path in files if "__pycache__" not in path.parts}


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_runs_in_its_short_form(name, tmp_path, request):
    if name == "pictures.py":
        request.getfixturevalue("vulkan")
    if name == "real_robots.py" and not SHARED.is_dir():
        pytest.skip(f"the real recordings {SHARED.name} are not beside this checkout")
    script, folder = STUDIES / name, tmp_path / "out"
    writes = '"-o"' in script.read_text()
    words = ["-W", "error", script, "--quick", *(["-o", folder] if writes else [])]
    threads = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    before = written()
    done = run(
        *(sys.executable, *words), cwd=tmp_path, env=os.environ | threads, timeout=1100, code=0
    )
    assert written() == before
    assert any(folder.iterdir() if writes else map(str.isdigit, done.stdout))
    if check := CHECKS.get(name):
        check(folder, done.stdout)
