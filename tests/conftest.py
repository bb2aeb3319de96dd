"""Signals, child processes and limits of all tests; fixtures of display tests and of full disks."""

import contextlib
import ctypes
import ctypes.util
import faulthandler
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import settings

EXAMPLES = int(os.environ.get("UNDULOG_EXAMPLES") or 30)
settings.register_profile("undulog", deadline=None, max_examples=EXAMPLES)  # no test is timed
settings.load_profile("undulog")
pytest.register_assert_rewrite("support")
pytest_plugins = ["support.clock_tests", "support.passed_tests"]

# In the background of a script or under nohup these are ignored, and every process that a test
# starts would inherit that. A handler is not inherited; this one goes on ignoring SIGHUP here.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)

PR_SET_CHILD_SUBREAPER = 36
# Processes that a failed test leaves behind become children of this one, which ends them.
ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def _children(since_s):
    """Return running children of this process, but for trackers of multiprocessing.

    Only those that began at a time since boot or later; a tracker is ended by multiprocessing
    itself.
    """
    first = int(since_s * os.sysconf("SC_CLK_TCK"))
    children = set()
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                facts = (folder / "stat").read_text().rpartition(")")[2].split()
                state, parent, began = facts[0], int(facts[1]), int(facts[19])
                is_tracker = b"tracker" in (folder / "cmdline").read_bytes()
                if parent == os.getpid() and state != "Z" and began >= first and not is_tracker:
                    children.add(int(folder.name))
    return children


def _end_children(since_s=0.0):
    """Kill running children; those of a killed one become children of this process."""
    for _ in range(10):
        children = _children(since_s)
        for pid in children:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)  # left to its Popen object
        if not children:
            return


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """End the processes that a test started before it failed or was interrupted."""
    began_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    try:
        with _watched(item, "call"):
            return (yield)
    except BaseException:
        _end_children(began_s)
        raise


LIMIT = "UNDULOG_TEST_LIMIT_S"
"""Environment variable: another limit for every test [s]; 0 for none, as for a debugger."""
LIMIT_S = 120.0
"""Longest time for the set-up, the call or the teardown of a test [s], after which the run ends
with all stacks: 80 times what a test takes that isn't marked slow."""
SLOW_LIMIT_S = 1200.0
"""The same for a test that is marked slow."""
WATCHER = Path(__file__).parent / "support" / "watcher.py"
_watching = None


def pytest_sessionstart(session):
    """Start the process that ends a run whose test stands still."""
    global _watching  # noqa: PLW0603
    capture = session.config.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled() if capture else contextlib.nullcontext():
        stderr = os.dup(2)  # that of the run, not of a test
    faulthandler.register(signal.SIGUSR2, file=stderr, all_threads=True)
    words = [sys.executable, "-S", "-E", str(WATCHER), str(stderr), str(os.getpid())]
    _watching = subprocess.Popen(words, stdin=subprocess.PIPE, pass_fds=[stderr])


def _watch(text=""):
    """Begin a wait of the watcher, or end it."""
    _watching.stdin.write(f"{text}\n".encode())
    _watching.stdin.flush()


@contextlib.contextmanager
def _watched(item, phase):
    is_long = any(map(item.get_closest_marker, ("slow", "nightly")))
    usual_s = SLOW_LIMIT_S if is_long else LIMIT_S
    limit_s = float(os.environ.get(LIMIT) or usual_s)
    _watch(f"{limit_s} {item.nodeid} ({phase})")
    try:
        yield
    finally:
        _watch()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item):
    """Limit the set-up of a test."""
    with _watched(item, "set-up"):
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item):
    """Limit the teardown of a test."""
    with _watched(item, "teardown"):
        return (yield)


def pytest_enter_pdb():
    """Give whoever debugs all the time there is."""
    _watch()


LEFT_OUT = {"built": "UNDULOG_BUILD_PAGES", "nightly": "UNDULOG_NIGHTLY"}
"""Markers of tests that are left out, and the environment variable that lets them in if it is 1:
the long parts of the manual are for `make pages`, what draws or simulates for long for `make
nightly`."""


def pytest_collection_modifyitems(config, items):
    """Leave tests to the targets that they are for."""
    unwanted = [mark for mark, variable in LEFT_OUT.items() if os.environ.get(variable) != "1"]
    left_out = {item for item in items if any(map(item.get_closest_marker, unwanted))}
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]


@pytest.hookimpl(trylast=True)
def pytest_collection_finish():
    """Exempt what was imported from garbage collection: a full one takes a quarter of a second.

    A recording exempts all that is there, and at its end nothing; here that stays exempt.
    """
    gc.collect()
    gc.freeze()
    gc.unfreeze = lambda: None


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """End all processes that still run."""
    if _watching is not None:
        _watching.stdin.close()
        _watching.wait(60)
    _end_children()


REQUIRE = "UNDULOG_REQUIRE_ALL_TESTS"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="session")
def display_tests_required():
    """Whether a missing display tool is a failure rather than a skip."""
    return os.environ.get(REQUIRE, "") not in ("", "0")


def _miss(missing, *, required):
    """Skip, or fail where all tests are required."""
    if required:
        pytest.fail(f"{missing}, and {REQUIRE} is set")
    pytest.skip(f"{missing}; set {REQUIRE}=1 to make this a failure")


@pytest.fixture(scope="session")
def chromium(display_tests_required):
    """Path of a Chromium; skips where there is none, fails where one is required."""
    if path := next(filter(None, map(shutil.which, NAMES)), None):
        return path
    missing = f"no Chromium on the path (looked for {', '.join(NAMES)})"
    return _miss(missing, required=display_tests_required)


@pytest.fixture(scope="session")
def vulkan(display_tests_required):
    """Skips where there is no Vulkan driver, fails where one is required."""
    folders = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    drivers = [file for folder in folders for file in folder.glob("*.json")]
    if not (ctypes.util.find_library("vulkan") and (drivers or named)):
        missing = "no Vulkan driver (Debian: mesa-vulkan-drivers libvulkan1)"
        _miss(missing, required=display_tests_required)


@pytest.fixture(scope="session")
def browser(chromium, tmp_path_factory):
    """A running Chromium with its own empty profile."""
    from support.browser import Browser

    started = Browser(chromium, Path(tmp_path_factory.mktemp("chromium")))
    yield started
    started.close()


@pytest.fixture
def webgl_browser(chromium, tmp_path):
    """A running Chromium that draws in three dimensions, by a renderer of its own."""
    from support.browser import FLAGS, WEBGL, Browser

    flags = [*(flag for flag in FLAGS if flag != "--disable-gpu"), *WEBGL, "--ignore-gpu-blocklist"]
    started = Browser(chromium, tmp_path / "chromium", patience_s=120.0, flags=flags)
    yield started
    started.close()


@pytest.fixture
def command(capsys):
    """Runs a command in this process and checks its exit code; returns its output and errors."""
    import undulog

    def run(*words, code=0):
        capsys.readouterr()
        assert undulog.run([str(word) for word in words]) == code
        return capsys.readouterr()

    return run


@pytest.fixture
def report_of(command):
    """Runs a command with ``--json``; returns its report."""
    return lambda *words, code=0: json.loads(command(*words, "--json", code=code).out)


@pytest.fixture
def opened():
    """Opens sessions by their paths; closes them after the test."""
    from undulog.capture import Session

    with contextlib.ExitStack() as stack:
        yield lambda path: stack.enter_context(Session.open(path))


@pytest.fixture(scope="module")
def programs(request):
    """Runs programs on a disk that forgets what isn't synced; the module's START is run once."""
    from support.forgetting_disk import Programs

    with Programs(request.module.START) as running:
        yield running


@pytest.fixture
def disk(tmp_path, programs):
    """That disk."""
    from support.forgetting_disk import ForgettingDisk

    return ForgettingDisk(tmp_path, programs)


@pytest.fixture
def disk_of(tmp_path):
    """Mounts a file system of a size, e.g. ``4m``; skips where that is not permitted."""
    place = tmp_path / "disk"

    def mount(size):
        place.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            pytest.skip(f"no mount: {error}")
        if done.returncode:
            pytest.skip(f"mounting is not permitted here: {done.stderr.strip()}")
        return place

    yield mount
    if place.is_mount():
        subprocess.run(["umount", str(place)], check=True)
