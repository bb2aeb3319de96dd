"""A headless Chromium, controlled by the DevTools protocol."""

import json
import os
import signal
import socket
import subprocess

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
    *("--disable-default-apps", "--disable-extensions", "--disable-sync", "--hide-scrollbars"),
)
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Drawing on the processor, for pages that take a graphics card."""


class Browser:
    """A headless Chromium, controlled by the DevTools protocol over a pair of pipes."""

    def __init__(self, path, profile, patience_s=60.0, flags=FLAGS):
        self._ours, theirs = socket.socketpair()
        self._ours.settimeout(patience_s)
        fd = theirs.fileno()
        # The protocol is spoken on descriptors 3 (to Chromium) and 4 (from it).
        shell = f'exec 3<&{fd} 4>&{fd}; exec "$@"'
        arguments = [path, *flags, "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        options = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        options |= {"pass_fds": (fd,), "start_new_session": True}
        command = ["bash", "-c", shell, "bash", *arguments, "about:blank"]
        self._process = subprocess.Popen(command, **options)
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
        while True:
            answer = self._receive()
            if answer.get("id") != self._number:
                self.events.append(answer)
            elif "error" in answer:
                raise RuntimeError(f"{method}: {answer['error']}")
            else:
                return answer["result"]

    def wait_for(self, event):
        """Wait for an event that has not been seen since ``open``."""
        while not any(e.get("method") == event for e in self.events):
            self.events.append(self._receive())

    def open(self, url, *, width=1280, height=900, dark=False, media="", scripts=True):
        """Load a page and wait until it is drawn; forgets earlier events."""
        self.call("Emulation.setScriptExecutionDisabled", value=not scripts)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media=media, features=[scheme])
        self.events = []
        self.call("Page.navigate", url=url)
        self.wait_for("Page.loadEventFired")
        if not scripts:
            return
        # Two frames later everything that loading caused has been reported.
        self.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")

    def evaluate(self, script):
        """Return the awaited value of a script; it runs whatever the page's policy."""
        options = {"awaitPromise": True, "returnByValue": True}
        result = self.call("Runtime.evaluate", expression=script, **options)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def press(self, key, *, shift=False):
        """Press and release a key, e.g. ``Tab``, ``ArrowRight`` or ``+``."""
        event = {"key": key, "code": key, "modifiers": 8 if shift else 0}
        event |= {"windowsVirtualKeyCode": 9} if key == "Tab" else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, **event)

    def mouse(self, kind, x, y, clicks=0):
        """Send one mouse event, e.g. ``mouseMoved``; with clicks it is of the left button."""
        button = {"button": "left", "clickCount": clicks} if clicks else {}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def requests(self):
        """Return the addresses requested since ``open``."""
        sent = (e for e in self.events if e.get("method") == "Network.requestWillBeSent")
        return [e["params"]["request"]["url"] for e in sent]

    def complaints(self):
        """Return console messages, log entries and exceptions since ``open``."""
        kinds = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
        return [e for e in self.events if e.get("method") in kinds]

    def close(self):
        """End this Chromium and nothing else."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._ours.close()

    def _receive(self):
        while b"\0" not in self._buffer:
            data = self._ours.recv(1 << 16)
            if not data:
                raise RuntimeError(f"Chromium ended, exit code {self._process.wait()}")
            self._buffer += data
        line, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(line)
