"""What display tests share: a Chromium, or a skip that says so."""

import contextlib
import ctypes
import ctypes.util
import json
import os
import shutil
import signal
import socket
import subprocess
import time
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
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-default-apps",
    "--disable-extensions",
    "--disable-sync",
    "--hide-scrollbars",
)
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Drawing on the processor, for pages that take a graphics card."""


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


class Browser:
    """One headless Chromium, spoken to by the DevTools protocol over a pair of pipes."""

    def __init__(self, path, profile, patience_s=60.0, flags=FLAGS):
        self.patience_s = patience_s
        self._ours, theirs = socket.socketpair()
        fd = theirs.fileno()
        # The protocol is spoken on descriptors 3 (to Chromium) and 4 (from it).
        shell = f'exec 3<&{fd} 4>&{fd}; exec "$@"'
        arguments = [path, *flags, "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *arguments, "about:blank"],
            pass_fds=(fd,),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        theirs.close()
        self._buffer = b""
        self._number = 0
        self.events = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    _session = None

    def call(self, method, **parameters):
        """Send one command and return its result; events on the way are kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._ours.sendall(json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + self.patience_s
        while True:
            answer = self._receive(deadline)
            if answer.get("id") != self._number:
                self.events.append(answer)
            elif "error" in answer:
                raise RuntimeError(f"{method}: {answer['error']}")
            else:
                return answer["result"]

    def wait_for(self, event):
        """Wait for an event that has not been seen since ``open``."""
        deadline = time.monotonic() + self.patience_s
        while not any(e.get("method") == event for e in self.events):
            self.events.append(self._receive(deadline))

    def open(self, url, *, width=1280, height=900, dark=False, media=""):
        """Load a page and wait until it is drawn; forgets earlier events."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media=media, features=[scheme])
        self.events = []
        self.call("Page.navigate", url=url)
        self.wait_for("Page.loadEventFired")
        # Two frames later everything that loading caused has been reported.
        self.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")

    def evaluate(self, script):
        """Value of a script, awaited; it runs beside the page, whatever the page's policy."""
        result = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def requests(self):
        """Addresses asked for since ``open``."""
        return [
            e["params"]["request"]["url"]
            for e in self.events
            if e.get("method") == "Network.requestWillBeSent"
        ]

    def complaints(self):
        """Console messages, log entries and exceptions since ``open``."""
        said = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
        return [e for e in self.events if e.get("method") in said]

    def close(self):
        """End this Chromium and nothing else."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._ours.close()

    def _receive(self, deadline):
        while b"\0" not in self._buffer:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError(f"Chromium said nothing for {self.patience_s} s")
            self._ours.settimeout(left)
            data = self._ours.recv(1 << 16)
            if not data:
                raise RuntimeError(f"Chromium ended, exit code {self._process.wait()}")
            self._buffer += data
        line, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(line)


@pytest.fixture(scope="session")
def browser(chromium, tmp_path_factory):
    """A running Chromium with its own empty profile."""
    started = Browser(chromium, Path(tmp_path_factory.mktemp("chromium")))
    yield started
    started.close()


@pytest.fixture
def webgl_browser(chromium, tmp_path):
    """A running Chromium that draws in three dimensions, by a renderer of its own."""
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
