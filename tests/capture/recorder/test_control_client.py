"""A client of the control socket against a bare socket that answers what the test says."""

import binascii
import contextlib
import fcntl
import json
import os
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from undulog.capture.common.errors import ControlError, SocketInUseError
from undulog.capture.recorder import control_client
from undulog.capture.recorder.control_client import (
    LOCK_PATIENCE_S,
    PATIENCE_S,
    ControlClient,
    default_sockets,
    listen,
    release,
    socket_folder,
)


@pytest.fixture
def line(tmp_path):
    """A client and the other end of its connection; answers are there before it asks."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        listener.bind(str(tmp_path / "c.sock"))
        listener.listen()
        client = stack.enter_context(ControlClient(tmp_path / "c.sock"))
        other = stack.enter_context(listener.accept()[0])
        yield client, other


# -- requests --------------------------------------------------------------------------------------


def test_requests_are_lines_of_json_and_replies_come_in_their_order(line):
    client, other = line
    requests = [{"do": "mark", "text": f"\n{k}"} for k in range(3)]
    replies = [{"ok": True, "number": k, "text": "ü"} for k in range(3)]
    other.sendall(b"".join(json.dumps(reply).encode() + b"\n" for reply in replies))
    assert client.ask_all(requests) == [{"number": k, "text": "ü"} for k in range(3)]
    lines = other.recv(4096).split(b"\n")
    assert [json.loads(text) for text in lines[:-1]] == requests
    assert lines[-1] == b""
    with pytest.raises(ValueError, match="not JSON compliant"):
        client.ask({"do": "gait", "values": {"a.b": float("nan")}})
    assert client.ask_all([]) == []


def test_more_than_was_asked_for_is_kept_for_the_next_request(line):
    client, other = line
    other.sendall(b'{"ok": true, "n": 1}\n{"ok": true, "n": 2}\n{"ok": true, "n')
    assert client.ask({"do": "x"}) == {"n": 1}
    assert client.ask({"do": "x"}) == {"n": 2}
    other.sendall(b'": 3}\n')
    assert client.ask({"do": "x"}) == {"n": 3}


def test_a_refusal_is_an_error_with_its_reason(line):
    client, other = line
    other.sendall(b'{"ok": false, "error": "not now"}\n{"ok": 0}\n{"ok": 1}\n')
    with pytest.raises(ControlError, match=r"^not now$"):
        client.ask({"do": "x"})
    with pytest.raises(ControlError, match=r"^refused$"):
        client.ask({"do": "x"})
    assert client.ask({"do": "x"}) == {}
    other.sendall(b'{"ok": true}\n{"ok": false, "error": "of two"}\n')
    with pytest.raises(ControlError, match=r"^of two$"):
        client.ask_all([{"do": "x"}] * 2)


@pytest.mark.parametrize(
    "answer", [b"220 mail", b"[1]", b"null", b"{}", b'"ok"', b"\xff", b"[" * 100_000]
)
def test_another_server_is_no_recorder(line, answer):
    client, other = line
    other.sendall(answer + b"\n")
    with pytest.raises(ControlError, match="what answers there is no recorder"):
        client.ask({"do": "x"})


@pytest.mark.parametrize("answers", [0, 1])
def test_a_recorder_that_ends_before_its_reply_is_reported(line, answers):
    client, other = line
    other.sendall(b'{"ok": true}\n' * answers)
    other.shutdown(socket.SHUT_WR)
    with pytest.raises(ControlError, match=r"c\.sock: the recorder went before it had answered"):
        client.ask_all([{"do": "x"}] * 2)


def test_a_closed_client_asks_no_more_and_waits_ten_seconds_at_most(line):
    client, _ = line
    assert client._socket.gettimeout() == PATIENCE_S == 10.0
    client.close()
    client.close()
    with pytest.raises(ControlError, match=r"c\.sock: the recorder went: "):
        client.ask({"do": "x"})


def test_where_no_recorder_listens_the_reason_is_told(tmp_path):
    (tmp_path / "file").touch()
    for name in ("none", "file"):
        with pytest.raises(ControlError, match=f"{name}: no recorder listens there"):
            ControlClient(tmp_path / name)
    with pytest.raises(ControlError, match="can't be reached: AF_UNIX path too long"):
        ControlClient(tmp_path / ("x" * 120))


# -- names -----------------------------------------------------------------------------------------


def test_a_recording_has_a_name_and_a_second_one_by_its_whole_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    environ = {"RUNTIME_DIRECTORY": f"{tmp_path}/s:/x", "XDG_RUNTIME_DIR": str(tmp_path)}
    assert socket_folder(environ) == tmp_path / "s"
    usual, other = default_sockets(Path("a/my.run.mcap"), environ)
    number = binascii.crc32(os.fsencode(tmp_path / "a" / "my.run.mcap"))
    assert usual == tmp_path / "s" / "my.run.sock"
    assert other == tmp_path / "s" / f"my.run-{number:08x}.sock"
    assert default_sockets(tmp_path / "a" / "my.run.mcap", environ) == (usual, other)
    (tmp_path / "file").touch()
    for folder, text in (("file", "no folder for the control socket: "), ("none/x", "No such")):
        with pytest.raises(ControlError, match=text):
            default_sockets(Path("run.mcap"), {"RUNTIME_DIRECTORY": str(tmp_path / folder)})
    (tmp_path / "link").symlink_to(tmp_path / "s")
    with pytest.raises(ControlError, match="link: not a folder of this user"):
        default_sockets(Path("run.mcap"), {"RUNTIME_DIRECTORY": str(tmp_path / "link")})


# -- the socket ------------------------------------------------------------------------------------


def test_a_recorder_whose_callers_wait_is_there(tmp_path):
    path = tmp_path / "c.sock"
    listener, identity = listen(path, backlog=0)
    assert not listener.getblocking()
    with contextlib.ExitStack() as stack:
        for _ in range(4):
            caller = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            caller.setblocking(False)
            last = caller.connect_ex(str(path))
        assert last != 0  # no further one can wait
        with pytest.raises(SocketInUseError, match="another recorder listens there"):
            listen(path, backlog=0)
    release(path, listener, identity)
    assert not path.exists()
    again, identity = listen(path, backlog=0)
    assert identity == (path.stat().st_dev, path.stat().st_ino)
    path.rename(tmp_path / "moved")
    path.touch()
    release(path, again, identity)
    assert path.exists()  # another one's


@pytest.mark.parametrize("free_at", [0, 5, 200, None])
def test_the_lock_of_a_folder_is_waited_for_2_s(tmp_path, monkeypatch, free_at):
    """In steps of 10 ms by the test's clock, after which the lock is free or not."""
    slept = []
    holder = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(holder, fcntl.LOCK_EX)

    def sleep(seconds):
        slept.append(seconds)
        if len(slept) == free_at:
            fcntl.flock(holder, fcntl.LOCK_UN)

    if free_at == 0:
        fcntl.flock(holder, fcntl.LOCK_UN)
    clock = SimpleNamespace(monotonic=lambda: 7.0 + len(slept) / 100, sleep=sleep)
    monkeypatch.setattr(control_client, "time", clock)
    if free_at is None:
        with pytest.raises(ControlError, match=r"c\.sock: no control socket can be made: "):
            listen(tmp_path / "c.sock", backlog=1)
        assert LOCK_PATIENCE_S == 2.0
        assert 2.0 <= len(slept) / 100 <= 2.02
        assert os.listdir(tmp_path) == []  # noqa: PTH208 - names alone
        with pytest.raises(ControlError):
            listen(tmp_path / "c.sock", backlog=1, patience_s=0.0)
    else:
        listener, identity = listen(tmp_path / "c.sock", backlog=1)
        assert slept == [0.01] * free_at
        other = os.open(tmp_path, os.O_RDONLY)
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)  # it is free again
        os.close(other)
        release(tmp_path / "c.sock", listener, identity)
    os.close(holder)
