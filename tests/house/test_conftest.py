"""Processes of failed tests are ended, and children get signals that the caller ignores."""

import shlex
import shutil
import sys

import pytest

from support.paths import ROOT
from support.processes import run

TESTS = """
import signal, subprocess, sys
from pathlib import Path

CODE = (
    "import signal as s, time; print(s.getsignal(2) == s.default_int_handler, s.getsignal(1) == 0,"
    " flush=True); time.sleep(900)"
)
started = []

def test_fails():
    shell = ["bash", "-c", f"{sys.executable} -c '{CODE}'; true"]
    started.append(subprocess.Popen(shell, stdout=subprocess.PIPE, text=True))
    assert started[0].stdout.readline() == "True True\\n"
    raise RuntimeError("on purpose")

def test_afterwards():
    assert started[0].wait(30) == -signal.SIGKILL
    running = [path for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    assert not any(CODE.encode() in path.read_bytes() for path in running)
"""


@pytest.mark.slow
def test_a_failed_test_ends_its_processes_where_signals_are_ignored(tmp_path):
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "test_two.py").write_text(TESTS)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = run("bash", "-c", f"trap '' INT HUP; exec {shlex.join(words)}", cwd=tmp_path)
    assert "1 failed, 1 passed" in done.stdout, done.stdout
    assert "RuntimeError: on purpose" in done.stdout
