"""Each promise of the page on reliability has tests that the continuous integration runs."""

import ast

import pytest

from support.paths import ROOT

GUARDS = {
    "A message that was accepted is in the session": (
        "capture/recorder/test_record_kill.py",
        "capture/recorder/test_record_pauses.py",
        "capture/recorder/test_record_faults.py",
        "capture/log/test_recover.py",
        "capture/log/wal/test_wal_damage.py",
        "capture/log/write/test_sink_power_loss.py",
    ),
    "No command leaves the gate beyond a position limit": (
        "sim/drive/test_gate_clamp.py",
        "sim/drive/test_gate_wild.py",
        "sim/drive/test_gate_crash.py",
    ),
    "No command reaches the bus beyond the step bound": (
        "sim/drive/test_gate_stall.py",
        "sim/drive/test_gate_confirmation.py",
        "sim/drive/test_loop_whole.py",
    ),
    "No input ends in a traceback or a signal": (
        "campaign/test_campaign.py",
        "capture/common/test_confined.py",
        "capture/common/test_streams.py",
        "capture/exchange/test_import_mutations.py",
        "capture/log/read/test_mutations.py",
        "sim/serve/test_garbage.py",
    ),
    "No input takes more than 1 GB or, below a few MB, 20 s of processor time": (
        "capture/exchange/test_hostile_files.py",
        "capture/log/file/test_hostile_bags.py",
        "analysis/catalog/test_queries.py",
    ),
    "No name or text acts on a terminal, page or spreadsheet": ("house/test_untrusted_text.py",),
    "What lies under an output's final name is whole": (
        "capture/log/write/test_ring.py",
        "capture/common/test_part_files.py",
        "capture/common/test_part_files_power_loss.py",
        "sim/twin/test_recording.py",
    ),
    "A recording that ends with exit code 0 had every source connected, and lost none": (
        "capture/recorder/test_links.py",
    ),
    "A recording whose folder is deleted or moved keeps what was accepted": (
        "capture/recorder/test_record_rescue.py",
    ),
    "A wait on another thread, program, server or disk has a limit": (
        "analysis/catalog/test_standing.py",
        "replay/test_standing.py",
        "replay/sweep/test_standing.py",
        "replay/test_stream_limits.py",
        "capture/common/test_parquet_trial.py",
    ),
    "Stored results that are damaged are found before they are used": (
        "analysis/catalog/test_files.py",
        "replay/sweep/test_sweep.py",
    ),
}
"""Test modules by the promise, as the first column of the page's table has it."""

LEFT_TO_THE_NIGHT = {"nightly", "built"}


def promises():
    """The first column of the first table of the page."""
    text = (ROOT / "docs" / "explanation" / "reliability.md").read_text()
    table = text.partition("## The promises")[2].partition("\n\n## ")[0]
    rows = [line.split("|")[1].strip() for line in table.splitlines() if line.startswith("|")]
    return rows[2:]


def marks_of(function):
    """Names of the markers of a test function."""
    marks = [ast.unparse(node).removeprefix("pytest.mark.") for node in function.decorator_list]
    return {mark.partition("(")[0] for mark in marks}


@pytest.mark.parametrize("promise", promises())
def test_a_promise_is_guarded_by_tests_of_every_integration(promise):
    for name in GUARDS[promise]:
        tree = ast.parse((ROOT / "tests" / name).read_text())
        for node in tree.body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark":
                assert not any(mark in ast.unparse(node.value) for mark in LEFT_TO_THE_NIGHT), name
        tests = [
            node
            for node in tree.body
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
        ]
        assert any(not marks_of(test) & LEFT_TO_THE_NIGHT for test in tests), name


def test_no_promise_is_listed_that_the_page_does_not_have():
    assert list(GUARDS) == promises()
