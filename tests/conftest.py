"""What display tests share: a Chromium, or a skip that says so."""

import contextlib
import ctypes
import ctypes.util
import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

pytest.register_assert_rewrite("support")

# In the background of a script or under nohup these are ignored, and every process that a test
# starts would inherit that. A handler is not inherited; this one goes on ignoring SIGHUP here.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)

PR_SET_CHILD_SUBREAPER = 36
# Processes that a failed test leaves behind become children of this one, which ends them.
ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def _children():
    """Processes whose parent this one is; multiprocessing ends its tracker itself."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == os.getpid() and b"tracker" not in (folder / "cmdline").read_bytes():
                    yield int(folder.name)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """End what is still running."""
    for _ in range(10):  # the children of those that end come here, too
        found = list(_children())
        for pid in found:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
        if not found:
            return


REQUIRE = "UNDULOG_REQUIRE_ALL_TESTS"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="session")
def display_tests_required():
    """Whether a missing display tool is a failure rather than a skip."""
    return os.environ.get(REQUIRE, "") not in ("", "0")


@pytest.fixture(scope="session")
def chromium(display_tests_required):
    """Path of a Chromium; skips where there is none, fails where one is required."""
    for name in NAMES:
        path = shutil.which(name)
        if path is not None:
            return path
    missing = f"no Chromium on the path (looked for {', '.join(NAMES)})"
    if display_tests_required:
        pytest.fail(f"{missing}, and {REQUIRE} is set")
    pytest.skip(f"{missing}; set {REQUIRE}=1 to make this a failure")


@pytest.fixture(scope="session")
def vulkan(display_tests_required):
    """Skips where there is no Vulkan driver, fails where one is required."""
    folders = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    drivers = [file for folder in folders for file in folder.glob("*.json")]
    if ctypes.util.find_library("vulkan") and (drivers or named):
        return
    missing = "no Vulkan driver (Debian: mesa-vulkan-drivers libvulkan1)"
    if display_tests_required:
        pytest.fail(f"{missing}, and {REQUIRE} is set")
    pytest.skip(f"{missing}; set {REQUIRE}=1 to make this a failure")


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
