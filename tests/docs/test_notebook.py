"""The example notebook of the manual runs from the first cell to the last."""

import json
import tempfile

import notebook_page
import pytest


@pytest.mark.parametrize(
    "path", [notebook_page.NOTEBOOK, *notebook_page.GALLERY], ids=lambda path: path.stem
)
def test_a_notebook_is_one_to_the_format_and_holds_no_outputs(path):
    notebook = json.loads(path.read_text())
    assert notebook["nbformat"] == 4
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


def test_a_cell_shows_what_it_prints_and_its_last_expression():
    run_cell, names = notebook_page.run_cell, {}
    assert run_cell("x = 2\nprint(x)", names) == ("2\n", None)
    assert run_cell("x += 1\nx * 2", names) == ("", 6)
    assert run_cell("", names) == ("", None)


@pytest.mark.nightly
def test_the_notebook_runs_says_what_its_text_says_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    page = notebook_page.executed_page()
    assert "B differs from A: joint03 most" in page
    assert "scenario.toml: servo_of.joint03.stall_torque: not set -> 0.2" in page
    assert page.count("<figure") == 3
    assert "```text\nTrue\n```" in page
    assert "differences.parquet" in page
    assert not any(tmp_path.iterdir())


SHOWN = {
    "animal": "first-to-last: 0.700 rad a joint",
    "bag": "c responds differently from the others, lag 5.7",
    "catalogue": "```text\nTrue\n```",
    "experiment": "joint03 answers less than its mirror joint07",
    "sweep": "4 of 4 runs, 4 of them now",
}
"""What each notebook of the gallery shows, known from the data that it makes."""


def test_every_notebook_of_the_gallery_is_tried():
    assert [path.stem for path in notebook_page.GALLERY] == sorted(SHOWN)


@pytest.mark.nightly
@pytest.mark.parametrize("path", notebook_page.GALLERY, ids=lambda path: path.stem)
def test_a_notebook_of_the_gallery_runs_shows_its_answer_and_leaves_nothing(
    path, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert SHOWN[path.stem] in notebook_page.executed_page(path)
    assert not any(tmp_path.iterdir())
