"""Tests of real time: how they are judged, and that no other test reads a clock."""

import sys

import pytest

from support.paths import ROOT
from support.processes import run
from support.witness import WINDOW_S, Lateness

TESTS = """
import time
from pathlib import Path

import pytest

LOG = Path(__file__).with_name("log")


def tries():
    with LOG.open("a") as log:
        log.write("x")
    return len(LOG.read_text())


@pytest.mark.clock(1e-9, "fails at first")
def test_of_a_late_computer(tmp_path):
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    assert tries() == 3


@pytest.mark.clock(1e-9, "never passes")
def test_that_is_never_judged():
    assert False


@pytest.mark.clock(1e9, "never passes, and the computer is in time")
def test_that_fails():
    assert False


def test_of_no_clock():
    assert not LOG.exists()
"""


def test_only_a_late_computer_is_a_reason_to_run_a_test_again(tmp_path, monkeypatch):
    (tmp_path / "test_one.py").write_text(TESTS)
    (tmp_path / "conftest.py").write_text(
        "from support import clock_tests, witness\n"
        "witness.LEAST_S = 0.0\n"
        "class Late(witness.Witness):\n"
        "    def late_s(self):\n"
        "        return super().late_s() + 1e-6\n"
        "clock_tests.Witness = Late\n"
    )
    words = ("-p", "support.clock_tests", "-p", "no:cacheprovider", "-o", "markers=clock: x")
    done = run(
        *(sys.executable, "-m", "pytest", "-c", "/dev/null", "--rootdir", tmp_path, *words),
        *("--junitxml", tmp_path / "junit.xml", tmp_path),
        env={"PATH": "", "PYTHONPATH": str(ROOT / "tests")},
    )
    assert "1 failed, 2 passed, 1 not judged" in done.stdout, done
    assert done.stdout.count("NOT JUDGED") == 1
    assert "test_that_is_never_judged: not judged: this computer was late by 0.0" in done.stdout
    junit = (tmp_path / "junit.xml").read_text()
    assert 'failures="1"' in junit
    assert 'skipped="1"' in junit


@pytest.mark.parametrize("wait_s", [0.0005, 0.1])
def test_lateness_is_what_was_waited_within_a_second(wait_s):
    late = Lateness()
    for number in range(50):
        late.add(number * 0.25, wait_s)
    assert late.longest_s == pytest.approx(0.5 if wait_s == 0.1 else 0.0)
    assert WINDOW_S == 1.0
