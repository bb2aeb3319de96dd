"""The service manager's protocol, on real notification sockets."""

import os
import shutil
import socket
import subprocess
import uuid
from contextlib import ExitStack, closing, suppress
from itertools import pairwise

import pytest

from undulog.capture.recorder.systemd import Notifier


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    """What a service manager listens on, and the name that it gives it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        if request.param == "path":
            name = str(tmp_path / "notify")
            listener.bind(name)
        else:
            name = f"@undulog-{uuid.uuid4()}"
            listener.bind("\0" + name[1:])
        listener.setblocking(False)
        yield name, listener


@pytest.fixture
def notifier_of():
    """Makes notifiers, and closes them after the test."""
    with ExitStack() as made:
        yield lambda environ: made.enter_context(closing(Notifier(environ)))


def heard(listener):
    """All messages that have come, as lists of lines."""
    messages = []
    with suppress(BlockingIOError):
        while True:
            messages.append(listener.recv(65536).decode().split("\n"))
    return messages


def test_a_recording_s_life(manager, notifier_of):
    name, listener = manager
    notifier = notifier_of({"NOTIFY_SOCKET": name})
    notifier.ready("recording can0")
    notifier.status("12 s, good")
    notifier.status("12 s, good")
    notifier.status("13 s,\nMAINPID=1\n good")
    notifier.stopping()
    assert heard(listener) == [
        ["READY=1", "STATUS=recording can0"],
        ["STATUS=12 s, good"],
        ["STATUS=13 s, MAINPID=1 good"],
        ["STOPPING=1"],
    ]
    notifier.close()
    notifier.close()
    notifier.status("late")
    assert heard(listener) == []
    assert notifier.failed == 0


@pytest.mark.skipif(shutil.which("systemd-notify") is None, reason="no systemd-notify on the path")
def test_the_words_are_those_of_systemd_notify(manager, monkeypatch, notifier_of):
    name, listener = manager
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    subprocess.run(["systemd-notify", "--no-block", "--ready", "--status=going on"], check=True)
    foreign = {line for message in heard(listener) for line in message if "PID" not in line}
    notifier_of(os.environ).ready("going on")
    (ours,) = heard(listener)
    assert set(ours) == foreign - {""} == {"READY=1", "STATUS=going on"}


def test_the_watchdog_is_fed_at_half_its_time_by_the_loop_s_clock(manager, notifier_of):
    name, listener = manager
    environ = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}
    notifier = notifier_of(environ)
    assert notifier.watchdog_ns == 2_000_000_000
    sent_ns = []
    for tick in range(2000):  # 10 s in ticks of 5 ms
        now_ns = 7_000_000_000 + tick * 5_000_000
        notifier.alive(now_ns)
        if heard(listener) == [["WATCHDOG=1"]]:
            sent_ns.append(now_ns)
    assert len(sent_ns) == 10
    assert all(b - a == 1_000_000_000 for a, b in pairwise(sent_ns))


OTHERS = {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}


@pytest.mark.parametrize(
    "environ",
    [{}, OTHERS, *({"WATCHDOG_USEC": text} for text in ("0", "soon", "-5", "²", "٣", " 5"))],
)
def test_a_watchdog_that_is_not_ours_or_no_time_is_not_fed(manager, environ, notifier_of):
    name, listener = manager
    notifier = notifier_of({"NOTIFY_SOCKET": name, **environ})
    assert notifier.watchdog_ns is None
    notifier.alive(10**12)
    assert heard(listener) == []


def test_who_is_a_service_and_how_often_its_watchdog_is_fed(manager, notifier_of):
    name, listener = manager
    notifier = notifier_of({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1"})
    assert (notifier.is_service, notifier.watchdog_ns, notifier.failed) == (True, 1000, 0)
    for now_ns in (0, 499, 500, 999, 1000, 1001):
        notifier.alive(now_ns)
    assert heard(listener) == [["WATCHDOG=1"]] * 3
    notifier.ready()
    notifier.status("")  # as it was
    notifier.status(" \n ")
    assert heard(listener) == [["READY=1"]]
    notifier.stopping()
    notifier.status("a")
    assert heard(listener) == [["STOPPING=1"], ["STATUS=a"]]


@pytest.mark.parametrize("name", ["", "relative/path", "vsock:2:1234"])
def test_without_a_manager_nothing_happens(name, notifier_of):
    notifier = notifier_of({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000"})
    assert not notifier.is_service
    notifier.ready("x")
    notifier.alive(10**12)
    notifier.stopping()
    assert notifier.failed == 0


def test_a_manager_that_hears_nothing_or_is_gone_never_holds_us_up(tmp_path, notifier_of):
    name = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(name)
        notifier = notifier_of({"NOTIFY_SOCKET": name})
        for k in range(5000):
            notifier.status(f"{k} s")
        full = notifier.failed
        assert full > 0
        deaf.setblocking(False)
        assert len(heard(deaf)) + full == 5000
        notifier.status("goes on")
        assert heard(deaf) == [["STATUS=goes on"]]
    notifier.status("to nobody")
    assert notifier.failed == full + 1
    notifier.close()


def test_a_long_status_is_cut_and_strange_letters_are_sent(manager, notifier_of):
    name, listener = manager
    notifier = notifier_of({"NOTIFY_SOCKET": name})
    notifier.status("x" * 100_000)
    notifier.status("\udc80 °C")
    assert heard(listener) == [["STATUS=" + "x" * 512], ["STATUS=? °C"]]
