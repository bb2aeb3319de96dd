"""``analyse``, ``report`` and dry runs of several sessions: a line and a page for each."""

import json
import re
import shutil
from itertools import pairwise

import pytest

from support.linear_chain import CHAIN, WAVE, M, write_run
from undulog.capture import load_robot


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A session of some joints, the same in a folder, and a file that is none."""
    place, robot = tmp_path_factory.mktemp("several"), load_robot("snake25")
    (place / "sub").mkdir()
    some = {"names": robot.joint_names[: 2 * M : 2], "robot": robot}
    write_run(place / "a.mcap", WAVE, CHAIN @ WAVE, 1, 0.003, **some)
    shutil.copy(place / "a.mcap", place / "sub/a.mcap")
    (place / "bad.mcap").write_text("junk")
    return place


@pytest.mark.slow
def test_analyse_of_a_folder_is_a_table_and_a_list_of_results(folder, tmp_path, command):
    lines = command("analyse", folder, code=1).out.splitlines()
    assert len(lines) == 4
    assert " snake25 " in lines[1]
    assert " Hz " in lines[1]
    assert "unlike" in lines[1]
    assert lines[2].startswith("bad.mcap")
    output = tmp_path / "all.json"
    results = json.loads(command("analyse", folder, "--json", "-o", output, code=1).out)
    assert json.loads(output.read_text()) == results
    alone = json.loads(command("analyse", folder / "a.mcap", "--json").out)
    assert results[0] == alone
    assert "not an MCAP file" in results[1]["error"]


@pytest.mark.slow
def test_named_files_are_one_experiment_unless_each_is_asked_for(folder, command):
    files = folder / "a.mcap", folder / "sub/a.mcap"
    assert command("analyse", *files).out.startswith("2 sessions: ")
    assert command("analyse", *files, "--each").out.startswith("session ")


@pytest.mark.slow
def test_an_experiment_with_a_bad_file_fails_and_shows_which(folder, command):
    shown = command("analyse", folder / "a.mcap", folder / "bad.mcap", code=1)
    assert "not an MCAP file" in shown.err
    assert [line.split()[0] for line in shown.out.splitlines()] == ["session", "a.mcap", "bad.mcap"]


@pytest.mark.slow
def test_report_into_a_folder_writes_a_page_each_and_an_index(folder, tmp_path, command):
    pages = tmp_path / "pages"
    command("report", folder, "-o", pages, code=1)
    assert sorted(page.name for page in pages.iterdir()) == ["a-2.html", "a.html", "index.html"]
    index = (pages / "index.html").read_text()
    assert re.findall(r'<a [^>]*href="([^#"][^"]*)"', index) == ["a.html", "a-2.html"]
    assert "not an MCAP file" in index
    assert "exists already" in command("report", folder, "-o", pages, code=2).err
    alone = tmp_path / "alone.html"
    command("report", folder / "a.mcap", "-o", alone)
    assert (pages / "a.html").read_text() == alone.read_text()


@pytest.mark.nightly
def test_a_folder_makes_one_page_with_an_index(folder, tmp_path, command):
    page = tmp_path / "all.html"
    printed = command("report", folder, "-o", page, code=1).out.splitlines()
    assert [line.split()[0].rpartition("/")[2] for line in printed[1:4]] == [
        *("a.mcap", "bad.mcap", "a.mcap")
    ]
    assert printed[4].startswith(f"{page}: ")
    text = page.read_text()
    ids = re.findall(r' id="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    index = re.search(r'<table class="index">.*?</table>', text, re.DOTALL)[0]
    assert re.findall(r'href="#([^"]+)"', index) == ["s1-answer", "s2-answer"]
    assert set(re.findall(r'href="#([^"]+)"', text)) <= {*ids}
    assert "not an MCAP file" in index
    assert text.index('class="index"') < text.index('id="s1-answer"') < text.index('id="s2-answer"')
    report = json.loads(command("analyse", folder / "a.mcap", "--json").out)
    first = report["answer"]["sentence"].partition(". ")[0].partition(" [")[0]
    assert first in index.replace("\N{NO-BREAK SPACE}", " ")
    levels = [int(level) for level in re.findall(r"<h([1-6])", text)]
    assert levels[0] == levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))


@pytest.mark.nightly
def test_named_files_are_one_page_by_themselves_only_if_asked(folder, tmp_path, command):
    files = folder / "a.mcap", folder / "sub/a.mcap"
    single, every = tmp_path / "one.html", tmp_path / "each.html"
    assert command("report", *files, "-o", single).out.startswith("2 sessions: ")
    command("report", *files, "--each", "-o", every)
    assert "of one experiment" in single.read_text()
    assert 'id="s2-answer"' in every.read_text()


@pytest.mark.nightly
def test_a_page_of_many_sessions_leaves_out_samples_then_refuses(
    folder, tmp_path, command, monkeypatch
):
    page, limit = tmp_path / "all.html", "undulog.analysis.present.page.LARGEST_BYTES"
    command("report", folder, "-o", page, code=1)
    full = page.read_text()
    monkeypatch.setattr(limit, len(full.encode()) * 0.7)
    command("report", folder, "-o", page, "--force", code=1)
    small = page.read_text()
    assert full.count("last analysed cycles") == 2
    assert (small.count("last analysed cycles"), small.count("are not drawn")) == (0, 2)
    monkeypatch.setattr(limit, 1000)
    refused = command("report", folder, "-o", tmp_path / "none.html", code=2)
    assert "-o FOLDER" in refused.err
    assert not (tmp_path / "none.html").exists()


def test_one_session_needs_a_page_not_a_folder(folder, tmp_path, command):
    assert (
        "end its name in .html" in command("report", folder / "a.mcap", "-o", tmp_path, code=2).err
    )


def test_dry_runs_of_several_motions_are_a_table(folder, command):
    words = ("--on", "can:virtual:x", "--duration", "0.1")
    shown = command("drive", "flat", folder, "nothere.toml", *words, code=1).out.splitlines()
    assert [line.split()[0].rpartition("/")[2] for line in shown] == [
        *("session", "flat", "a.mcap", "bad.mcap", "a.mcap", "nothere.toml")
    ]
    assert "would run" in shown[1]
    assert "without --arm" in command("drive", "flat", "twist", "--arm", *words, code=2).err
