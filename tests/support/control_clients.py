"""Raw clients of the control socket, and other recorders."""

import contextlib
import json
import socket
import subprocess
import sys

from support.processes import process, repeating, wait_for
from undulog.capture.common.errors import DataError

PATIENCE_S = 60.0


def echo(request):
    """Return the request; some requests have effects."""
    if request.get("do") == "refuse":
        raise DataError("not now")
    if request.get("do") == "big":
        return {"text": "x" * request["size"]}
    if request.get("do") == "mistake":
        return {"value": float("nan")} if request.get("nan") else {}["none"]
    if request.get("do") == "later":
        return None
    return {"got": dict(request)}


def polled(server, pause_s=0.001):
    """Poll a server in a thread, as the recorder's loop does."""
    return repeating(server.poll, pause_s)


def connected(server):
    """Connect a raw client with a timeout."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(str(server.path))
    client.settimeout(PATIENCE_S)
    return client


def polls(server, until):
    """Poll until a condition holds."""
    wait_for(until, meanwhile=server.poll)


def replies(data):
    """Return the reply lines, each read as JSON."""
    assert data.endswith(b"\n")
    return [json.loads(line) for line in data.splitlines()]


def drain(server, client, count):
    """Poll and read until so many reply lines have come."""
    data = b""
    client.setblocking(False)

    def enough():
        nonlocal data
        server.poll()
        with contextlib.suppress(BlockingIOError):
            got = client.recv(65536)
            assert got, "the server let go"
            data += got
        return data.count(b"\n") >= count

    wait_for(enough, "the replies")
    client.settimeout(PATIENCE_S)
    return replies(data)


@contextlib.contextmanager
def started_recorder(path, extra="", first="ready\n"):
    """Start a process that serves the socket until it is killed; it prints 'ready' or the error."""
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from undulog.capture.recorder.control import ControlServer\n"
        "from undulog.capture.common.errors import ControlError\n"
        f"{extra}\n"
        "try:\n"
        f"    server = ControlServer(Path({str(path)!r}), lambda request: {{}})\n"
        "except ControlError as error:\n"
        "    sys.exit(print(error, flush=True))\n"
        "print('ready', flush=True)\n"
        "while True:\n"
        "    server.poll()\n"
        "    time.sleep(0.005)\n"
    )
    with process(sys.executable, "-c", code, stdin=subprocess.PIPE) as running:
        assert running.stdout.readline() == first
        yield running
