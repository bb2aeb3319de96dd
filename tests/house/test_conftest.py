"""Processes of failed and hung tests are ended; children get signals that the caller ignores."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT
from support.processes import run, wait_for
from support.watcher import passed, scheduled

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

def command_line(path):
    try:
        return path.read_bytes()
    except OSError:  # it has ended meanwhile
        return b""


def test_afterwards():
    assert started[0].wait() == -signal.SIGKILL
    running = [command_line(path) for path in Path("/proc").glob("[0-9]*/cmdline")]
    assert not any(CODE.encode() in line for line in running)
"""


HANGING = """
import ctypes, os, subprocess, threading, time

def wait_in_a_thread():
    time.sleep(900)

def start_processes():
    # The second one is a grandchild in a session of its own.
    shell = "sleep 901 & exec setsid sleep 902"
    print(subprocess.Popen(["bash", "-c", shell]).pid, flush=True)
    threading.Thread(target=wait_in_a_thread, daemon=True).start()

def test_before():
    pass

def test_waits_for_ever():
    start_processes()
    time.sleep(900)

def test_holds_the_interpreter():
    start_processes()
    ctypes.PyDLL(None).sleep(900)  # PyDLL doesn't release the lock of the interpreter

def test_afterwards():
    print("afterwards")
"""


MARKED = """
import pytest

@pytest.mark.slow
def test_slow(): pass

@pytest.mark.slow
@pytest.mark.built("part")
def test_built(): pass

@pytest.mark.slow
@pytest.mark.nightly
def test_nightly(): pass
"""


def copy_conftest(folder):
    """Copy what limits tests to a folder of its own."""
    (folder / "support").mkdir()
    support = (f"support/{name}.py" for name in ("watcher", "clock_tests", "witness"))
    for name in ("conftest.py", *support):
        shutil.copy(ROOT / "tests" / name, folder / name)


def running(folder):
    """Return the names of the processes that a run in a folder has left."""
    names = []
    for cwd in Path("/proc").glob("[0-9]*/cwd"):
        with contextlib.suppress(OSError):
            if cwd.readlink() == folder:
                names.append((cwd.parent / "cmdline").read_bytes().replace(b"\0", b" "))
    return names


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("variable", "expected"),
    [("", {"slow"}), ("BUILD_PAGES", {"slow", "built"}), ("NIGHTLY", {"slow", "nightly"})],
)
def test_a_marker_leaves_its_tests_to_their_target(tmp_path, variable, expected):
    copy_conftest(tmp_path)
    (tmp_path / "test_marked.py").write_text(MARKED)
    words = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-p", "no:cacheprovider"]
    inherited = {k: v for k, v in os.environ.items() if not k.endswith(("BUILD_PAGES", "NIGHTLY"))}
    done = run(*words, tmp_path, cwd=tmp_path, env=inherited | {f"UNDULOG_{variable}": "1"})
    assert set(re.findall(r"::test_(\w+)", done.stdout)) == expected, done.stdout


@pytest.mark.parametrize(
    ("ran_s", "waited_s", "counts_s"),
    [(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.1, 0.9, 0.1), (0.1, 1.8, 0.1), (1.9, 3.0, 1.0)],
    ids=["asleep", "busy", "kept waiting", "two kept waiting", "busy and kept waiting"],
)
def test_only_time_in_which_a_run_could_go_on_counts(ran_s, waited_s, counts_s):
    before, after = {"main": (5.0, 7.0)}, {"main": (5.0 + ran_s, 7.0 + waited_s), "new": (9.0, 9.0)}
    assert passed(before, after) == pytest.approx(counts_s)


def test_a_thread_s_time_on_a_processor_is_counted():
    with subprocess.Popen(["yes"], stdout=subprocess.DEVNULL) as process:
        wait_for(lambda: sum(ran for ran, _ in scheduled([process.pid]).values()) > 0.05, "work")
        process.kill()


@pytest.mark.nightly
@pytest.mark.parametrize("test", ["waits_for_ever", "holds_the_interpreter"])
def test_a_test_that_stands_still_ends_the_run_with_all_stacks(tmp_path, test):
    copy_conftest(tmp_path)
    (tmp_path / "test_three.py").write_text(HANGING)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path]
    words += ["-k", f"before or {test} or afterwards"]
    done = run(*words, cwd=tmp_path, env=os.environ | {"UNDULOG_TEST_LIMIT_S": "4"})
    assert done.returncode == -signal.SIGKILL, done.stdout
    assert f"test_three.py::test_{test} (call) stood still for 4 s; all stacks:" in done.stderr
    assert re.search(rf'File ".*test_three.py", line \d+ in test_{test}', done.stderr)
    assert re.search(r'File ".*test_three.py", line \d+ in wait_in_a_thread', done.stderr)
    assert done.stderr.endswith("the run is ended\n")
    assert "afterwards" not in done.stdout
    wait_for(lambda: running(tmp_path) == [], "all processes to end")


@pytest.mark.nightly
def test_a_limit_of_zero_is_none(tmp_path):
    copy_conftest(tmp_path)
    (tmp_path / "test_one.py").write_text("import time\ndef test_long(): time.sleep(5)\n")
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path]
    done = run(*words, cwd=tmp_path, env=os.environ | {"UNDULOG_TEST_LIMIT_S": "0"})
    assert "1 passed" in done.stdout, done


@pytest.mark.nightly
def test_a_failed_test_ends_its_processes_where_signals_are_ignored(tmp_path):
    copy_conftest(tmp_path)
    (tmp_path / "test_two.py").write_text(TESTS)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = run("bash", "-c", f"trap '' INT HUP; exec {shlex.join(words)}", cwd=tmp_path)
    assert "1 failed, 1 passed" in done.stdout, done.stdout
    assert "RuntimeError: on purpose" in done.stdout
