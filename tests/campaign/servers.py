"""Clients that send garbage, stay silent or leave half-way; then a good client is served."""

import json
import os
import random
import re
import signal
import socket
import time
from collections import Counter
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from support.processes import wait_for

from .base import DBC, ROBOT, SCENARIO, write_files
from .case import Result, run_command

PATIENCE_S = 30.0
MORE = 4
"""So many descriptors more than before may stay: of threads and files opened on the first use."""
WORDS = (
    b"< open can0 >", b"< rawmode >", b"< send 123 2 11 F1 >", b"< send 123 8 1 >", b"<>",
    b"> <", b"< bcmmode >", b"< send 1AAAAAAAA 0 >", b"<" * 5000, b"< send " + b"F" * 100_000,
    b"\x1b[2J", b'{"do": "status"}\n', b'{"do": "mark", "text": "\\u001b[2J"}\n',
    b"[" * 20_000 + b"\n", b'{"do": []}\n', b"{" * 9000, b"GET / HTTP/1.1\r\n", b"\0" * 4096,
    b"\xff\xfe\n",
)  # fmt: skip


def _connect(address):
    kind = socket.AF_UNIX if isinstance(address, str) else socket.AF_INET
    link = socket.socket(kind, socket.SOCK_STREAM)
    link.settimeout(PATIENCE_S)
    deadline = time.monotonic() + PATIENCE_S
    while True:  # a full backlog refuses at once
        try:
            link.connect(address)
        except BlockingIOError:
            if time.monotonic() > deadline:
                link.close()
                raise
            time.sleep(0.01)
            continue
        return link


@contextmanager
def _closing():
    links = []
    try:
        yield links
    finally:
        for link in links:
            with suppress(OSError):
                link.close()


def attack(address, rng, links):
    """Connect forty clients: some send garbage, some nothing, some leave half-way or at once."""
    for _ in range(40):
        kind = rng.choice(["garbage", "silent", "half", "gone", "deaf"])
        with suppress(OSError):
            link = _connect(address)
            if kind == "gone":
                link.close()
                continue
            links.append(link)
            link.settimeout(0.2)
            if kind == "garbage":
                for _ in range(rng.randrange(1, 12)):
                    link.sendall(rng.choice([*WORDS, rng.randbytes(rng.randrange(1, 3000))]))
            elif kind == "half":
                link.sendall(rng.choice(WORDS)[: rng.randrange(1, 9)])
                link.shutdown(socket.SHUT_WR)
            elif kind == "deaf":  # takes the bus and never reads
                link.sendall(b"< open can0 >< rawmode >")


def _received(link, until):
    data = b""
    deadline = time.monotonic() + PATIENCE_S
    while not until(data) and time.monotonic() < deadline:
        with suppress(TimeoutError):
            got = link.recv(65536)
            if not got:
                break
            data += got
    return data


def _wait(condition):
    return wait_for(condition, "the server", PATIENCE_S)


def _answer(address, words, is_good):
    """Return the fault of the answer that a client gets; empty where it is good."""
    with suppress(OSError), _connect(address) as link:
        link.settimeout(0.5)
        link.sendall(words)
        data = _received(link, is_good)
        return "" if is_good(data) else f"only {data[:80]!r}"
    return "the connection was refused or closed"


def _descriptors(pid):
    return len(os.listdir(f"/proc/{pid}/fd"))  # noqa: PTH208


def _targets(pid):
    targets = Counter[str]()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):  # closed meanwhile
            targets[str(link.readlink()).split("[")[0]] += 1
    return ", ".join(f"{count} x {target}" for target, count in targets.items())


def _check_descriptors(result, pid, before, of=""):
    """Check that after the clients no more descriptors are open than before."""
    with suppress(AssertionError):
        _wait(lambda: _descriptors(pid) <= before + MORE)
    if (left := _descriptors(pid)) > before + MORE:
        text = f"descriptors: {before} before, {left} after{of}: {_targets(pid)}"
        result.failures.append(text)


def _watched(result, pid, address, rng, good, *, foreign=False):
    """Attack a server; a good client comes while the bad ones stay and after they left.

    A foreign server's answer beside the bad ones is only counted, and so is a connection that it
    closes directly after them, if it then answers.
    """
    before = _descriptors(pid)
    with _closing() as links:
        attack(address, rng, links)
        fault = good()
        result.at_most("n_locked_out", float(bool(fault)))
        if fault and not foreign:
            result.failures.append(f"locked out: beside {len(links)} clients: {fault}")
    fault = good()
    if fault and foreign:
        # It may close one connection more while it drops the bad ones: a browser asks again.
        result.at_most("n_closed_after", 1.0)
        with suppress(AssertionError):
            _wait(lambda: not good())
        fault = good()
    if fault:
        result.failures.append(f"locked out: after the attack: {fault}")
    _check_descriptors(result, pid, before)


def _attacked(result, folder, words, *, rng, ready, request, end_by=signal.SIGTERM, **how):
    """Run a server under attack.

    Args:
        result: Receives the failures.
        folder: The working folder.
        words: The command line of the server.
        rng: Generator of the attack.
        ready: Returns the address as soon as the server listens.
        request: Bytes that a good client sends, and whether an answer is right.
        end_by: Signal that ends the server.
        how: ``foreign``, see :func:`_watched`; ``more``, a further attack on the process, which
            gets the good client.
    """

    def meanwhile(pid):
        try:
            good = partial(_answer, _wait(ready), *request)
            _watched(result, pid, good.args[0], rng, good, foreign=how.get("foreign", False))
            how.get("more", lambda *_: None)(pid, good)
        except (AssertionError, ValueError) as error:
            result.failures.append(f"server: {error}")
        os.kill(pid, end_by)

    outcome = run_command(words, folder, meanwhile=meanwhile)
    result.add(outcome)
    return outcome


def serve(result, folder, rng, _stage):
    """``sim serve``: the good client gets the robot's frames."""
    (folder / "long.toml").write_text(SCENARIO.replace("duration_s = 0.1", "duration_s = 600.0"))
    out = folder.parent / f"{folder.name}.out"

    def ready():
        line = out.read_bytes().split(b"\n")[0] if out.exists() else b""
        return ("127.0.0.1", json.loads(line)["port"]) if line else None

    words = ["sim", "serve", "long.toml", "--socketcand", "0", "--json"]
    request = b"< open can0 >< rawmode >", lambda data: b"< frame 20" in data
    _attacked(result, folder, words, rng=rng, ready=ready, request=request)


def control(result, folder, rng, _stage):
    """A recorder's control socket, and its source: status is answered, senders are received."""
    path, source = str(folder / "c.sock"), str(folder / "s.sock")

    def silent_senders(pid, good):
        before = _descriptors(pid)
        with _closing() as silent:
            for _ in range(100):
                with suppress(OSError):
                    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                    link.settimeout(0.5)
                    link.connect(source)
                    with suppress(OSError):
                        link.send(rng.randbytes(rng.choice([1, 31, 33, 48, 8192])))
                    silent.append(link)
            if fault := good():
                result.failures.append(f"locked out: beside {len(silent)} senders: {fault}")
        _check_descriptors(result, pid, before, " senders")

    words = ["record", f"unix:{source}", "--quiet", "--floor", "1MB"]
    words += ["--socket", path, "-o", "new.mcap"]
    request = b'{"do": "status"}\n', lambda data: b'"ok":true' in data.replace(b" ", b"")

    def ready():
        return path if Path(path).exists() and Path(source).exists() else None

    how = {"rng": rng, "ready": ready, "request": request}
    outcome = _attacked(result, folder, words, **how, more=silent_senders)
    if outcome.code != 0:
        result.failures.append(f"recorder: exit code {outcome.code}: {outcome.err[-200:]!r}")


def viewer(result, folder, rng, stage):
    """The page of ``view --web``, by Rerun's own server: it is served again afterwards."""
    (folder / "gait.mcap").write_bytes(stage.files_of("gait.mcap")["gait.mcap"])
    out = folder.parent / f"{folder.name}.out"

    def ready():
        match = out.exists() and re.search(rb"127\.0\.0\.1:(\d+)", out.read_bytes())
        return ("127.0.0.1", int(match.group(1))) if match else None

    words = ["view", "gait.mcap", "--web"]
    page = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    how = {"rng": rng, "ready": ready, "request": (page, lambda data: data.startswith(b"HTTP/1"))}
    _attacked(result, folder, words, **how, foreign=True, end_by=signal.SIGINT)


ATTACKS = {"sim serve": serve, "record": control, "view --web": viewer}


def run(seed, stage):
    """Attack one server."""
    rng = random.Random(seed)
    name = list(ATTACKS)[seed % len(ATTACKS)]
    result = Result(f"{name}: forty bad clients")
    with stage.fresh() as folder:
        write_files(folder, {"snake4.toml": ROBOT, "snake4.dbc": DBC})
        ATTACKS[name](result, folder, rng, stage)
    return result
