"""Rules of the house that no linter holds."""

import sys

import pytest

from support.paths import ROOT
from support.processes import run


def _tracked():
    done = run("git", "ls-files", cwd=ROOT)
    if done.returncode:
        pytest.skip("not a git checkout: the list of tracked files is unknown")
    return done.stdout.splitlines()


def test_no_package_folder_of_the_tests_shadows_ours():
    assert [str(p) for p in (ROOT / "tests").rglob("__init__.py")] == []


def test_no_recording_or_output_is_tracked_but_those_that_tests_are_held_to():
    recordings = [name for name in _tracked() if name.endswith((".mcap", ".rrd", ".candump.log"))]
    earlier = "tests/capture/log/read/earlier/"  # sessions of earlier versions, small ones
    assert all((ROOT / name).stat().st_size < 100_000 for name in recordings if earlier in name)
    recordings = [name for name in recordings if earlier not in name]
    assert recordings == ["tests/replay/golden/session.mcap"]


def test_every_bench_finds_what_it_imports():
    names = sorted(path.stem for path in (ROOT / "bench").glob("*.py"))
    assert "twin_step" in names
    done = run(sys.executable, "-c", f"import {', '.join(names)}", cwd=ROOT / "bench")
    assert done.returncode == 0, done.stderr
