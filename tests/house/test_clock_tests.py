"""Tests of real time: how they are judged, and that no other test reads a clock."""

import ast
import re
import subprocess
import sys

import pytest

from support.paths import ROOT
from support.processes import run
from support.witness import WINDOW_S, Lateness, of_others

TESTS = """
import time
from pathlib import Path

import pytest

from support.witness import LateComputerError

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


@pytest.mark.clock(1e9, "the witness saw nothing, a process of the test did")
def test_of_real_time_that_saw_it_late():
    with LOG.with_name("seen").open("a") as log:
        log.write("x")
    if len(LOG.with_name("seen").read_text()) < 3:
        raise LateComputerError("0.1 s")


def test_of_no_clock():
    assert not LOG.exists()


OTHER = Path(__file__).with_name("other")


def test_that_saw_it_late(tmp_path):
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    OTHER.write_text(OTHER.read_text() + "x" if OTHER.exists() else "x")
    if len(OTHER.read_text()) < 3:
        raise LateComputerError("0.1 s")


def test_that_sees_it_late_each_time():
    raise LateComputerError("0.2 s")
"""


@pytest.mark.nightly
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
    assert "1 failed, 4 passed, 2 not judged" in done.stdout, done
    assert done.stdout.count("NOT JUDGED") == 2
    assert "each_time: not judged: this computer was late by 0.2 s; 0.2 s; 0.2 s" in done.stdout
    assert "test_that_is_never_judged: not judged: this computer was late by 0.0" in done.stdout
    junit = (tmp_path / "junit.xml").read_text()
    assert 'failures="1"' in junit
    assert 'skipped="2"' in junit


@pytest.mark.parametrize("wait_s", [0.0005, 0.1])
def test_lateness_is_what_was_waited_within_a_second(wait_s):
    late = Lateness()
    for number in range(50):
        late.add(number * 0.25, wait_s)
    assert late.longest_s == pytest.approx(0.5 if wait_s == 0.1 else 0.0)
    assert WINDOW_S == 1.0


@pytest.mark.parametrize(
    ("tested_s", "others_s", "lateness_s"),
    [
        (0.0, 0.0, 0.1),  # a timer, or the virtual machine's host
        (0.1, 0.0, 0.0),  # the test's own load, on one processor or on two
        (0.2, 0.0, 0.0),
        (0.04, 0.0, 0.06),
        (0.1, 0.1, 0.1),  # another program on one of two processors
        (0.05, 0.2, 0.1),
        (0.15, 0.03, 0.03),
    ],
)
def test_a_wait_for_the_tests_own_processes_is_no_lateness(tested_s, others_s, lateness_s):
    assert of_others(0.1, tested_s, others_s) == pytest.approx(lateness_s)


BUSY = "import time\nwhile time.process_time() < {s}: pass\nprint('done', flush=True)\ninput()"
LOAD = "import subprocess, sys\nsubprocess.run([sys.executable, '-S', '-c', {busy!r}])"
METER = """
from support.witness import ProcessorTimes
times = ProcessorTimes()
print("begun", flush=True)
input()
print(*times.since(1e9))
"""
TEST = """
import subprocess, sys
pipes = {{"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}}
meter = subprocess.Popen([sys.executable, "-c", {meter!r}], **pipes)
meter.stdout.readline()
load = subprocess.Popen([sys.executable, "-S", "-c", {load!r}], **pipes)
print(load.stdout.readline(), end="", flush=True)
input()
print(meter.communicate("\\n")[0])
load.communicate("\\n")
"""


@pytest.mark.nightly
def test_processor_times_are_told_apart_by_who_began_the_processes(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests"))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    script = TEST.format(meter=METER, load=LOAD.format(busy=BUSY.format(s=0.2)))
    test = subprocess.Popen([sys.executable, "-c", script], **pipes)
    assert test.stdout.readline() == "done\n"
    other = subprocess.Popen([sys.executable, "-S", "-c", BUSY.format(s=1.0)], **pipes)
    assert other.stdout.readline() == "done\n"
    tested_s, others_s = map(float, test.communicate("\n")[0].split())
    other.communicate("\n")
    assert 0.2 <= tested_s < 1.0 <= others_s


# -- no other test reads a clock -------------------------------------------------------------------

TIMES = [
    "clock_gettime", "clock_gettime_ns", "monotonic", "monotonic_ns", "perf_counter",
    "perf_counter_ns", "process_time", "process_time_ns", "sleep", "thread_time", "thread_time_ns",
    "time", "time_ns",
]  # fmt: skip
CLOCKS = {("threading", "Timer"), *(("time", name) for name in TIMES)}
WAITS = {"wait", "join", "poll", "select"}
LEAST_LIMIT_S = 10.0
"""A shorter limit of a wait is a time that something is given, not one after which a test fails."""
MOST_CLOCK_TESTS = 40
MAY_READ_A_CLOCK = re.compile(
    r"import time|from time|Timer|\btime\.|timeout=|\.(wait|join|poll|select)\(\s*[\d.]|mark\.clock"
)
EXEMPT = {
    "conftest.py": "limits every test",
    "campaign": "attacks at random moments",
    "zoo": "faults at all times",
    "mutants": "limits the tests of each mutant",
    "support/watcher.py": "limits every test",
    "support/witness.py": "measures how late the computer is",
    "support/processes.py": "waits for events, wait_for; gives stages time, pause",
    "support/far_end.py": "a robot and a router that keep to time, as processes",
    "support/bus_listener.py": "a listener that keeps time, as a process",
}


def reads_a_clock(node):
    """Whether code calls a clock, sleeps, or waits for a short time."""
    for part in ast.walk(node):
        if isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
            if (part.value.id, part.attr) in CLOCKS:
                return True
        elif isinstance(part, ast.ImportFrom) and part.module in {"time", "threading"}:
            if part.module == "time" or "Timer" in {alias.name for alias in part.names}:
                return True
        elif isinstance(part, ast.Call) and isinstance(part.func, ast.Attribute):
            limits = [*part.args, *(word.value for word in part.keywords if word.arg == "timeout")]
            if part.func.attr in WAITS and any(is_short(limit) for limit in limits):
                return True
    return False


def gives_time(node):
    """Whether code gives processes time, as stages under ``tests/support`` may."""
    for part in ast.walk(node):
        if isinstance(part, ast.ImportFrom) and part.module == "support.processes":
            if "pause" in {alias.name for alias in part.names}:
                return True
        elif isinstance(part, ast.Attribute) and ast.unparse(part) == "processes.pause":
            return True
    return False


def is_short(node):
    """Whether it is a time, and a short one; 0 is no wait."""
    if not isinstance(node, ast.Constant) or not isinstance(node.value, int | float):
        return False
    return not isinstance(node.value, bool) and 0 < node.value < LEAST_LIMIT_S


def is_clock(nodes):
    """Whether one of some expressions is the mark of a test of real time."""
    return any("mark.clock(" in ast.unparse(node) for node in nodes)


def looked_at(path):
    """Return the tests of a module that are marked, and what reads a clock without a mark.

    A helper, class or fixture may read one if all that name it are marked.
    """
    body = ast.parse(path.read_text()).body
    named = {
        definition.name: definition
        for definition in body
        if isinstance(definition, ast.FunctionDef | ast.ClassDef)
    }
    marks = [
        statement.value
        for statement in body
        if isinstance(statement, ast.Assign) and "pytestmark" in map(ast.unparse, statement.targets)
    ]
    marked = {
        name for name, definition in named.items() if is_clock([*marks, *definition.decorator_list])
    }
    tests = {name for name in named if name.startswith("test_")}
    tainted = {name for name, definition in named.items() if reads_a_clock(definition)}
    others = [statement for statement in body if statement not in named.values()]
    wrong = {"the module" for other in others if reads_a_clock(other)}
    while True:
        users = {
            name
            for name, definition in named.items()
            if name not in marked and names_of(definition) & (tainted - tests)
        }
        if users <= tainted:
            break
        tainted |= users
    helpers = tainted - tests - names_of(*(named[name] for name in named if name != ""))
    return marked & tests, wrong | (tainted & tests - marked) | helpers


def names_of(*nodes):
    """Return the names that code uses, arguments included, which may be fixtures."""
    return {
        part.id if isinstance(part, ast.Name) else part.arg
        for node in nodes
        for part in ast.walk(node)
        if isinstance(part, ast.Name | ast.arg)
    }


def test_no_other_test_reads_a_clock():
    tests, marked, wrong = ROOT / "tests", [], []
    for path in sorted(tests.rglob("*.py")):
        name = path.relative_to(tests).as_posix()
        if EXEMPT.keys() & {name, name.partition("/")[0]}:
            continue
        text = path.read_text()
        if "pause" in text and not name.startswith("support/") and gives_time(ast.parse(text)):
            wrong.append(f"{name}: pause")
        if MAY_READ_A_CLOCK.search(text):
            of_clock, faults = looked_at(path)
            marked += [f"{name}::{test}" for test in of_clock]
            wrong += [f"{name}: {fault}" for fault in sorted(faults)]
    assert not wrong
    assert 0 < len(marked) <= MOST_CLOCK_TESTS


def test_the_search_finds_clocks(tmp_path):
    code = """
import time, pytest

def pause():
    time.sleep(0.1)

def held():
    thread.join(0.5)

def test_patient():
    process.wait()

def test_of_a_helper():
    pause()

def test_of_a_timer():
    threading.Timer(gap, stop).start()

def test_of_a_timer_by_its_name():
    from threading import Timer

def test_of_no_clock():
    from threading import Thread
    simulated.sleep(1)

@pytest.mark.clock(0.1, "why")
def test_marked():
    held()
    time.monotonic()
"""
    (tmp_path / "test_one.py").write_text(code)
    marked, wrong = looked_at(tmp_path / "test_one.py")
    assert (marked, wrong) == (
        {"test_marked"},
        {"test_of_a_helper", "test_of_a_timer", "test_of_a_timer_by_its_name"},
    )
