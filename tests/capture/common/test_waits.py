"""Waits end with a result, with progress go on, and without it end with a sentence."""

import os
import signal

import pytest

from support.processes import freeze, python_started, wait_for
from support.simulated_clock import SimulatedClock
from undulog.capture.common import waits
from undulog.capture.common.errors import NoAnswerError, UndulogError
from undulog.capture.common.waits import (
    Standstill,
    attended,
    calls_go_on,
    end_process,
    processor_time,
)

COMMAND = """
import atexit, sys, threading, time
import undulog
from undulog.capture.common.errors import NoAnswerError
from undulog.capture.common.waits import attended

def run(_):
    atexit.register(print, "taken down", flush=True)
    print("done")
    try:
        attended(lambda: time.sleep(float(sys.argv[1])), "it", "wait", limit_s=0.1)
    except NoAnswerError:
        return 1
    return 0

undulog.run = run
undulog.main()
"""

TRACER = """
import ctypes, os, sys, time
libc = ctypes.CDLL(None, use_errno=True)
SEIZE = 0x4206
libc.ptrace.argtypes = [ctypes.c_long] * 4
failed = libc.ptrace(SEIZE, int(sys.argv[1]), 0, 0)
print("refused" if failed else "seized", flush=True)
time.sleep(600)
"""


@pytest.fixture
def silent():
    """A call that returns only when a pipe is closed, as at the end of the test."""
    reads, writes = os.pipe()
    yield lambda: os.read(reads, 1)
    os.close(writes)


def test_a_result_and_an_exception_come_through():
    assert attended(lambda: 7, "it", "do something") == 7
    with pytest.raises(ZeroDivisionError):
        attended(lambda: 1 // 0, "it", "do something")


def test_a_call_that_never_returns_ends_with_who_how_long_and_what_to_do(silent):
    with pytest.raises(NoAnswerError) as caught:
        attended(silent, "the far end", "start it again", limit_s=0.2)
    assert str(caught.value) == "the far end did not answer within 0.2 s; start it again"
    assert isinstance(caught.value, UndulogError)
    assert isinstance(caught.value, TimeoutError)


def test_progress_extends_a_wait(silent):
    seen = []

    def progress():
        seen.append(len(seen))
        return min(len(seen), 40)

    with pytest.raises(NoAnswerError):
        attended(silent, "it", "wait", limit_s=0.5, progress=progress)
    assert len(seen) > 40


def test_a_look_can_end_a_wait(silent):
    def look():
        raise KeyError("no longer")

    with pytest.raises(KeyError, match="no longer"):
        attended(silent, "it", "wait", look=look)


def test_a_call_that_was_given_up_goes_on_until_it_returns():
    reads, writes = os.pipe()
    with pytest.raises(NoAnswerError):
        attended(lambda: os.read(reads, 1), "it", "wait", limit_s=0.1)
    assert calls_go_on()
    os.close(writes)
    wait_for(lambda: not calls_go_on(), "the end of the call")


@pytest.mark.parametrize(
    ("seconds", "code", "printed"), [("600", 1, "done\n"), ("0", 0, "done\ntaken down\n")]
)
def test_with_a_call_that_goes_on_the_process_ends_without_being_taken_down(seconds, code, printed):
    with python_started(COMMAND, seconds) as process:
        assert process.communicate()[0] == printed
    assert process.returncode == code


def test_time_in_which_the_process_itself_was_stopped_does_not_count():
    simulated = SimulatedClock()
    still = Standstill(3.0, simulated.clock)
    for stopped_s, reached in ((600.0, False), (0.5, False), (1e6, False), (0.5, True)):
        simulated.pass_s(stopped_s)
        assert still.reached() is reached
    assert not still.reached("progress")
    simulated.pass_s(2.9)
    assert not still.reached("progress")  # a second of it, for all that is known


def test_a_process_that_ignores_the_request_is_killed():
    program = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1, flush=True)"
    process = python_started(f"{program}; time.sleep(600)")
    assert process.stdout.readline() == "1\n"
    end_process(process, "it", grace_s=0.2)
    end_process(process, "it", grace_s=0.2)
    assert process.returncode == -signal.SIGKILL
    process.communicate()


def test_a_process_that_nobody_can_end_is_named(monkeypatch):
    monkeypatch.setattr(waits, "KILLED_S", 0.5)
    process = python_started("import time; time.sleep(600)")
    # What a tracer has seized stays a zombie of the tracer: its parent waits in vain.
    with python_started(TRACER, process.pid) as tracer:
        try:
            if tracer.stdout.readline() != "seized\n":
                pytest.skip("tracing is not permitted here")
            with pytest.raises(
                NoAnswerError, match=f"kernel holds it; look at process {process.pid}"
            ):
                end_process(process, "the program")
        finally:
            tracer.kill()
    assert process.wait() == -signal.SIGKILL
    process.communicate()


def test_processor_time_grows_with_work_alone():
    busy, idle = (
        python_started(text) for text in ("while True: pass", "import time; time.sleep(600)")
    )
    try:
        pids = busy.pid, idle.pid
        wait_for(lambda: processor_time(pids)[0] > 50, "work")
        freeze(busy.pid)
        freeze(idle.pid)
        stopped = processor_time(pids)
        with python_started("while True: pass") as other:
            wait_for(lambda: processor_time([other.pid])[0] > 20, "work of another process")
            other.kill()
        assert processor_time(pids) == stopped
    finally:
        for process in (busy, idle):
            process.kill()
            process.communicate()
    assert processor_time([busy.pid]) == (0,)
