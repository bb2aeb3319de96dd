"""Raw clients of the control socket, and other recorders."""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time

from support.processes import start, wait_for
from undulog.capture.common.errors import DataError
from undulog.capture.recorder.control import LATER

PATIENCE_S = 60.0
RECORDER = """
import sys, time
from pathlib import Path
from undulog.capture.recorder.control import ControlServer
from undulog.capture.common.errors import ControlError
{extra}
try:
    server = ControlServer(Path({path!r}), lambda request: {{}})
except ControlError as error:
    sys.exit(print(error, flush=True))
print('ready', flush=True)
while True:
    server.poll()
    time.sleep(0.005)
"""


def echo(request):
    """Return the request; some requests have effects."""
    if request.get("do") == "refuse":
        raise DataError("not now")
    if request.get("do") == "big":
        return {"text": "x" * request["size"]}
    if request.get("do") == "mistake":
        return {"value": float("nan")} if request.get("nan") else {}["none"]
    if request.get("do") == "later":
        return LATER
    return {"got": dict(request)}


@contextlib.contextmanager
def polled(server, pause_s=0.001):
    """Poll a server in a thread, as the recorder's loop does."""
    ended = threading.Event()

    def loop():  # an exception in here fails the test: pytest warns of it
        while not ended.is_set():
            server.poll()
            time.sleep(pause_s)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def connected(server):
    """Connect a raw client with a timeout."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(str(server.path))
    client.settimeout(PATIENCE_S)
    return client


def polls(server, until):
    """Poll until a condition holds."""
    wait_for(until, each=server.poll)


def replies(data):
    """Return the reply lines, each read as JSON."""
    assert data.endswith(b"\n")
    return [json.loads(line) for line in data.splitlines()]


def drain(server, client, count):
    """Poll and read until so many reply lines have come."""
    data = b""
    client.setblocking(False)
    deadline = time.monotonic() + PATIENCE_S
    while data.count(b"\n") < count:
        assert time.monotonic() < deadline
        server.poll()
        with contextlib.suppress(BlockingIOError):
            got = client.recv(65536)
            assert got, "the server let go"
            data += got
    client.settimeout(PATIENCE_S)
    return replies(data)


def start_recorder(path, extra=""):
    """Start a process that serves the socket until it is killed; it prints 'ready' or the error."""
    code = RECORDER.format(extra=extra, path=str(path))
    return start(sys.executable, "-c", code, stdin=subprocess.PIPE, stderr=None)


def end(process):
    process.send_signal(signal.SIGKILL)
    process.communicate()
