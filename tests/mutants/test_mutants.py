"""The drawing and counting of mutants."""

import pytest

from mutants import delays, run
from support.paths import ROOT

CODE = """
from __future__ import annotations
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    LIMIT = 3

def area(width: tuple[1, 2], height: float = 4.0) -> dict[5, 6]:
    return width * height
"""


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A tree of one module, which is all that is mutated."""
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "area.py").write_text(CODE)
    monkeypatch.setattr(run, "ROOT", tmp_path)
    monkeypatch.setattr(run, "PARTS", {"area": ["capture"]})
    return tmp_path


def test_what_is_only_for_the_type_checker_is_not_mutated(tree):
    mutants = run.mutants_of(tree / "capture" / "area.py")
    lines = CODE.splitlines()
    assert {mutant.line for mutant in mutants} == {7, 8}
    assert {lines[6][mutant.column] for mutant in mutants if mutant.line == 7} == {"4"}


def test_draws_are_one_a_place_and_the_same_for_a_seed(tree):
    chosen = run.drawn(3, 100)
    assert chosen == run.drawn(3, 100)
    assert len({(mutant.line, mutant.column) for mutant in chosen}) == len(chosen) > 1
    assert {run.drawn(seed, 1)[0].operator for seed in range(40)} > {chosen[0].operator}


def test_the_tests_that_import_a_module_come_first():
    first, *others = run.tests_of("capture/log/wal/reader.py")
    assert "undulog.capture.log.wal.reader" in first.read_text()
    assert {other.parent for other in (first, *others)} == {ROOT / "tests" / "capture/log/wal"}


def test_a_run_goes_on_and_counts_what_survived(tmp_path):
    path = tmp_path / "rows.jsonl"
    mutants = [run.Mutant("replay/samples/a.py", line, 0, "core/X", 0) for line in range(1, 5)]
    results = run.Mutants(path)
    assert results.add(mutants[0], "failed", 1.0, "a -> b")["killed"]
    assert not results.add(mutants[1], "passed", 1.0, "c -> d")["killed"]
    assert results.add(mutants[2], "failed", 20.0, "e -> f")["killed"]
    assert not results.add(mutants[3], "limit", 60.0, "g -> h")["killed"]
    again = run.Mutants(path)
    assert again.done == set(mutants)
    lines = run.summary(again.rows)
    assert "| samples of the replay | 4 | 2 |" in lines
    assert "| all | 4 | 2, 50% |" in lines
    assert [line.split(": ")[2].split(" (")[0] for line in lines if "survived" in line] == [
        "c -> d",
        "g -> h",
    ]


@pytest.mark.parametrize("delay", delays.DELAYS, ids=lambda delay: delay.test.rpartition("::")[2])
def test_there_is_a_place_for_each_delay(delay):
    whole = (ROOT / delay.path).read_text()
    assert delays.planted(whole, delay, 2 * delays.tolerance_of(delay.test)) != whole
