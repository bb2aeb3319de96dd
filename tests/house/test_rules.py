"""Rules of the house that no linter holds."""

import sys

import pytest

from support.paths import ROOT
from support.processes import run, tracked


def test_no_package_folder_of_the_tests_shadows_ours():
    assert [str(p) for p in (ROOT / "tests").rglob("__init__.py")] == []


def test_no_recording_or_output_is_tracked_but_those_that_tests_are_held_to():
    names = [str(path.relative_to(ROOT)) for path in tracked()]
    recordings = [name for name in names if name.endswith((".mcap", ".rrd", ".candump.log"))]
    earlier = "tests/capture/log/read/earlier/"  # sessions of earlier versions, small ones
    assert all((ROOT / name).stat().st_size < 100_000 for name in recordings if earlier in name)
    recordings = [name for name in recordings if earlier not in name]
    assert recordings == ["tests/replay/golden/session.mcap"]


@pytest.mark.nightly
def test_every_bench_finds_what_it_imports():
    names = sorted(path.stem for path in (ROOT / "bench").glob("*.py"))
    assert "twin_step" in names
    run(sys.executable, "-c", f"import {', '.join(names)}", cwd=ROOT / "bench", code=0)
