"""Commands and other processes run from tests, and patience with them."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from support.paths import ROOT

UNDULOG = (sys.executable, "-m", "undulog")
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}


def run(*words, code=None, **options):
    """Run a process to its end; its exit code is ``code``, or for the caller to check."""
    options = PIPES | {"timeout": 300} | options
    done = subprocess.run([str(word) for word in words], check=False, **options)
    assert code in (None, done.returncode), (words, done)
    return done


def undulog(*words, **options):
    return run(*UNDULOG, *words, **options)


def python(program, *words, **options):
    return run(sys.executable, "-c", program, *words, **options)


def tracked(*patterns):
    """Return the files that git tracks; skips where there is no checkout."""
    import pytest

    done = run("git", "ls-files", "--", *patterns, cwd=ROOT)
    if done.returncode:
        pytest.skip("not a git checkout: the list of tracked files is unknown")
    return [ROOT / name for name in done.stdout.splitlines()]


def start(*words, **options):
    """Start a process whose output goes to pipes."""
    return subprocess.Popen([str(word) for word in words], **(PIPES | options))


def python_started(program, *words, **options):
    return start(sys.executable, "-c", program, *words, **options)


@contextmanager
def process(*words, **options):
    """Start a process that is ended with the block."""
    running = start(*words, **options)
    try:
        yield running
    finally:
        if running.poll() is None:
            running.send_signal(signal.SIGCONT)  # a stopped one would not end
            running.terminate()
        try:
            running.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            running.kill()
            running.communicate(timeout=20)


@contextmanager
def serving(scenario, *words, place="0", **options):
    """Run a virtual robot; yield its process and its report when it is ready."""
    serve = (*UNDULOG, "sim", "serve", scenario, "--socketcand", place, "--json", *words)
    with process(*serve, **options) as robot:
        line = robot.stdout.readline()
        assert line, robot.communicate()
        yield robot, json.loads(line)


def wait_for(condition, what="", seconds=600.0, *, meanwhile=lambda: None, alive=(), pause_s=0.005):
    """Return the value of a condition as soon as it holds; the processes ``alive`` must run."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        for running in alive:
            assert running.poll() is None, (what, running.communicate())
        assert time.monotonic() < deadline, f"waited {seconds} s for {what}"
        meanwhile()
        time.sleep(pause_s)
    return value


def pause(seconds):
    """Give other processes time; for stages alone, of tests that claim nothing of that time."""
    time.sleep(seconds)


@contextmanager
def repeating(step, pause_s):
    """Call a function again and again in a thread, until the end of the block.

    An exception in it fails the test: pytest warns of it.
    """
    ended = threading.Event()

    def loop():
        while not ended.wait(pause_s):
            step()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def once(condition, then, what):
    """Call a function as soon as a condition holds, in a thread, while the block waits for it."""

    def watch():
        wait_for(condition, what)
        then()

    with ThreadPoolExecutor(1) as pool:
        watching = pool.submit(watch)
        yield
        watching.result()


def processor_ticks(pid):
    """Return what a process has computed so far, in ticks of the kernel."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(words[11]) + int(words[12])


def alive(pid):
    """Return whether a process runs; one that has ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def parent_of(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def freeze(pid):
    """Stop a process, and wait until all its threads are stopped."""
    os.kill(pid, signal.SIGSTOP)
    threads = Path(f"/proc/{pid}/task")

    def states():
        return {
            (thread / "stat").read_text().rpartition(")")[2].split()[0]
            for thread in threads.iterdir()
        }

    wait_for(lambda: states() == {"T"}, "all threads to stand")


@contextmanager
def served_page(file, scratch):
    """Run ``undulog view --web``; yield the process and the address once the page answers."""
    with process(
        *UNDULOG, "view", file, "--web", env={**os.environ, "TMPDIR": str(scratch)}
    ) as viewer:
        address = wait_for(
            lambda: _page(viewer.stdout.readline().strip()), "an address", alive=(viewer,)
        )
        wait_for(lambda: _answers(address.partition("?")[0]), "the page", alive=(viewer,))
        yield viewer, address


def _page(line):
    return line if line.startswith("http") else None


def _answers(page):
    try:
        with urllib.request.urlopen(page, timeout=5) as answer:
            return answer.status == 200
    except OSError:
        return False


def listening(*ports):
    """Return address, as the kernel prints it, and port of sockets that listen at some ports."""
    tables = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
    lines = [
        line for table in tables if table.exists() for line in table.read_text().splitlines()[1:]
    ]
    local = [line.split()[1].split(":") for line in lines if line.split()[3] == "0A"]
    return {(address, int(port, 16)) for address, port in local if int(port, 16) in ports}
