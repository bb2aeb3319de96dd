"""The control socket against real clients: slow, silent, mad and many."""

import contextlib
import fcntl
import os
import resource
import signal
import socket
import struct
import termios
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support import control_clients as clients
from support.processes import once, wait_for
from undulog.capture.common.errors import ControlError
from undulog.capture.recorder import control
from undulog.capture.recorder.control import BUFFER, MAX_CLIENTS, ControlServer
from undulog.capture.recorder.control_client import ControlClient


@pytest.fixture
def server(tmp_path):
    """A server that the test polls."""
    server = ControlServer(tmp_path / "c.sock", clients.echo)
    yield server
    server.close()


@pytest.fixture
def client(server):
    with clients.connected(server) as client:
        yield client


# -- requests and replies ------------------------------------------------------------------------


def test_each_request_gets_its_reply_in_order_on_one_connection(server, client):
    client.sendall(b"".join(b'{"do": "n", "k": %d}\n' % k for k in range(500)))
    assert [reply["got"]["k"] for reply in clients.drain(server, client, 500)] == list(range(500))
    assert server.requests == 500


def test_a_socket_can_be_claimed_before_it_is_served(tmp_path):
    server = ControlServer(tmp_path / "c.sock")
    with pytest.raises(ControlError, match="another recorder listens there"):
        ControlServer(server.path)
    with clients.polled(server), ControlClient(server.path) as client:
        with pytest.raises(ControlError, match="not begun yet"):
            client.ask({"do": "x"})
        server.serve(clients.echo)
        assert client.ask({"do": "x"}) == {"got": {"do": "x"}}
    server.close()


def test_a_request_may_come_in_pieces(server, client):
    for byte in b'{"do": "x"}\n':
        client.sendall(bytes([byte]))
        server.poll()
    assert clients.drain(server, client, 1) == [{"ok": True, "got": {"do": "x"}}]


def test_a_client_that_ends_its_side_still_gets_the_reply_even_without_a_newline(server, client):
    client.sendall(b'{"do": "a"}\n{"do": "b"}')
    client.shutdown(socket.SHUT_WR)
    assert [reply["got"]["do"] for reply in clients.drain(server, client, 2)] == ["a", "b"]
    clients.polls(server, lambda: len(server._clients) == 0)
    assert client.recv(10) == b""


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"status", "not JSON"),
        (b"[1]", "a request is a JSON object"),
        (b'"status"', "a request is a JSON object"),
        (b'{"do": NaN}', "not JSON: NaN"),
        (b"\xff\xfe\xfd", "not JSON"),
        (b"[" * 60_000, "not JSON"),
        (b"9" * 60_000, "not JSON"),
        (b'{"do": "refuse"}', "not now"),
        (b'{"do": "big", "size": 70000}', "the reply has"),
    ],
)
def test_a_bad_request_gets_an_error_and_the_connection_lives(server, client, line, why):
    client.sendall(line + b"\n" + b'{"do": "x"}\n')
    bad, good = clients.drain(server, client, 2)
    assert not bad["ok"]
    assert why in bad["error"]
    assert good["ok"]


def test_a_mistake_of_ours_is_reported_and_ends_nothing(server, client):
    client.sendall(b'{"do": "mistake"}\n{"do": "mistake", "nan": true}\n{"do": "x"}\n')
    first, second, third = clients.drain(server, client, 3)
    assert "KeyError" in first["error"]
    assert "ValueError" in second["error"]
    assert third["ok"]
    assert ["mistake" in fault for fault in server.take_faults()] == [True, True]
    assert server.take_faults() == ()


@pytest.mark.slow
@given(st.binary(max_size=400))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_whatever_comes_each_line_gets_one_line(server, data):
    expected = sum(bool(line.strip()) for line in data.split(b"\n"))
    with clients.connected(server) as client:
        clients.polls(server, lambda: len(server._clients) == 1)
        client.sendall(data)
        client.shutdown(socket.SHUT_WR)
        got = b""
        clients.polls(server, lambda: len(server._clients) == 0)
        while piece := client.recv(65536):
            got += piece
    assert got.count(b"\n") == expected
    assert all("ok" in reply for reply in (clients.replies(got) if got else []))


# -- nobody holds the recorder up ----------------------------------------------------------------


def test_a_client_that_never_reads_costs_bounded_memory_and_no_one_else_s_time(server):
    with clients.connected(server) as mad, clients.connected(server) as good:
        mad.setblocking(False)
        request = b'{"do": "big", "size": 9000}\n' * 100
        good.sendall(b'{"do": "x"}\n')
        data, worst = b"", 0
        good.setblocking(False)
        for _ in range(2000):
            with contextlib.suppress(BlockingIOError):
                mad.send(request)
            server.poll()
            for client in server._clients.values():
                worst = max(worst, len(client.outgoing), len(client.incoming))
            with contextlib.suppress(BlockingIOError):
                data += good.recv(4096)
        assert clients.replies(data) == [{"ok": True, "got": {"do": "x"}}]
        assert worst <= 2 * BUFFER + 16 * 1024
        good.sendall(b'{"do": "y"}\n')
        assert clients.drain(server, good, 1)[0]["got"] == {"do": "y"}
        # Once it reads, it gets whole replies.
        mad.settimeout(clients.PATIENCE_S)
        with clients.polled(server):
            data = b""
            while data.count(b"\n") < 20:
                data += mad.recv(65536)
        whole = data[: data.rindex(b"\n") + 1]
        assert all(len(reply["text"]) == 9000 for reply in clients.replies(whole))


def test_a_request_without_end_is_refused_and_the_client_let_go(server, client):
    client.setblocking(False)
    data = b""
    for _ in range(1000):
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            client.send(b"x" * 8192)
        server.poll()
        if len(server._clients) == 0 and data:
            break
        with contextlib.suppress(BlockingIOError):
            data += client.recv(4096)
    (reply,) = clients.replies(data)
    assert "longer than 65536 bytes" in reply["error"]
    assert len(server._clients) == 0


def test_silent_clients_make_room_for_the_next_the_longest_silent_first(server):
    silent = [clients.connected(server) for _ in range(MAX_CLIENTS)]
    clients.polls(server, lambda: len(server._clients) == MAX_CLIENTS)
    for client in silent[1:]:
        client.sendall(b'{"do": "x"}\n')
        clients.drain(server, client, 1)
    with clients.connected(server) as late:
        late.sendall(b'{"do": "stop"}\n')
        assert clients.drain(server, late, 1)[0]["ok"]
        assert len(server._clients) == MAX_CLIENTS
        (reply,) = clients.replies(silent[0].recv(4096))
        assert not reply["ok"]
        assert silent[0].recv(10) == b""
    for client in silent:
        client.close()
    clients.polls(server, lambda: len(server._clients) == 0)


def test_a_flood_is_taken_in_portions(server, client, monkeypatch):
    """With no budget left, one request a client and poll."""
    monkeypatch.setattr(control, "BUDGET_NS", -1)
    client.sendall(b'{"do": "x"}\n' * 50)
    counts = []
    clients.polls(server, lambda: counts.append(server.requests) or server.requests == 50)
    assert all(b - a <= 1 for a, b in pairwise(counts))
    assert len(clients.drain(server, client, 50)) == 50


def test_clients_that_vanish_leave_nothing_behind(server):
    for k in range(200):
        client = clients.connected(server)
        client.sendall(b'{"do": "big", "size": 60000}\n' * (1 + k % 3))
        if k % 2:
            server.poll()
        client.close()
    for _ in range(10):
        server.poll()
    clients.polls(server, lambda: len(server._clients) == 0)
    assert len(server._selector.get_map()) == 1


def test_without_descriptors_the_recorder_goes_on(server):
    """Clients are not served then, and that's all."""
    with clients.connected(server) as client:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        used = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir())
        resource.setrlimit(resource.RLIMIT_NOFILE, (used, hard))
        try:
            spare = []
            with contextlib.suppress(OSError):
                while True:
                    spare.append(os.dup(0))
            for _ in range(10):
                server.poll()
        finally:
            for handle in spare:
                os.close(handle)
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        client.sendall(b'{"do": "x"}\n')
        assert clients.drain(server, client, 1)[0]["ok"]


# -- stop and wait -------------------------------------------------------------------------------


def test_the_reply_to_a_later_answer_comes_with_the_close(server):
    with clients.polled(server):
        client = clients.connected(server)
        client.sendall(b'{"do": "later"}\n{"do": "x"}\n')
        wait_for(lambda: server.requests)
    for _ in range(10):
        server.poll()
    assert server.requests == 1, "what comes after waits"
    server.close({"verdict": "good"})
    server.close({"verdict": "twice"})
    with client:
        assert clients.replies(client.recv(4096)) == [{"ok": True, "verdict": "good"}]


def unread_bytes(connection):
    """What was sent on a socket, and not read at its other end [byte]."""
    (count,) = struct.unpack("i", fcntl.ioctl(connection, termios.TIOCOUTQ, bytes(4)))
    return count


def test_a_client_gets_an_error_when_the_recorder_dies_before_it_answers(tmp_path):
    path = tmp_path / "c.sock"
    with clients.started_recorder(path) as process, ControlClient(path) as client:
        client.ask({"do": "x"})
        process.send_signal(signal.SIGSTOP)
        with (
            once(lambda: unread_bytes(client._socket), process.kill, "it was asked"),
            pytest.raises(ControlError, match="the recorder went"),
        ):
            client.ask({"do": "x"})


def test_a_recorder_that_hangs_is_reported(tmp_path):
    server = ControlServer(tmp_path / "c.sock", clients.echo)
    with (
        ControlClient(server.path, patience_s=0.1) as client,
        pytest.raises(ControlError, match=r"no answer in 0\.1 s"),
    ):
        client.ask({"do": "x"})
    server.close()
