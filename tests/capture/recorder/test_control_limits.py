"""The control socket at its limits: longest requests and replies, turns of the clients, faults."""

import contextlib
import json
import selectors
import socket

import pytest

from support import control_clients as clients
from undulog.capture.recorder import control
from undulog.capture.recorder.control import BUFFER, MAX_CLIENTS, ControlServer


@pytest.fixture
def answers():
    """What the server's handler is called with, and what it answers; an exception is raised."""
    return {"asked": [], "reply": {}}


@pytest.fixture
def server(tmp_path, answers):
    def handle(request):
        answers["asked"].append(request)
        reply = answers["reply"]
        if isinstance(reply, Exception):
            raise reply
        return reply

    server = ControlServer(tmp_path / "c.sock", handle)
    yield server
    server.close()


def test_the_limits_are_64_kib_and_16_clients():
    assert (BUFFER, MAX_CLIENTS) == (65_536, 16)
    assert (control.BUDGET_NS, control.TEND_POLLS) == (1_000_000, 200)


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_request_of_64_kib_is_taken_and_no_longer_one(server, answers, beyond):
    text = b'{"do": "x", "pad": ""}'
    line = text.replace(b'""', b'"' + b"a" * (BUFFER + beyond - len(text) - 1) + b'"') + b"\n"
    assert len(line) == BUFFER + beyond
    with clients.connected(server) as client, clients.polled(server, pause_s=0):
        client.sendall(line)
        reply = json.loads(client.makefile().readline())
    assert reply["ok"] is not bool(beyond)
    assert len(answers["asked"]) == 1 - beyond
    if beyond:
        assert reply["error"] == "a request is longer than 65536 bytes"


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_reply_of_64_kib_is_sent_and_no_longer_one(server, answers, beyond):
    empty = json.dumps({"ok": True, "text": ""}) + "\n"
    answers["reply"] = {"text": "x" * (BUFFER + beyond - len(empty))}
    with clients.connected(server) as client, clients.polled(server, pause_s=0):
        client.sendall(b'{"do": "x"}\n')
        line = client.makefile().readline()
    reply = json.loads(line)
    if beyond:
        assert (reply["ok"], reply["error"]) == (False, "the reply has 65537 bytes")
    else:
        assert (reply["ok"], len(line)) == (True, BUFFER)


def test_clients_take_turns_in_being_the_first(server, answers, monkeypatch):
    """With no budget left each has one request a poll."""
    monkeypatch.setattr(control, "BUDGET_NS", -1)
    some = [clients.connected(server) for _ in range(3)]
    clients.polls(server, lambda: len(server._clients) == 3)
    for number, client in enumerate(some):
        client.sendall(b'{"n": %d}\n' % number * 30)
    firsts = set()
    for _ in range(29):
        del answers["asked"][:]
        server.poll()
        turn = [request["n"] for request in answers["asked"]]
        assert sorted(turn) == [0, 1, 2]
        firsts.add(turn[0])
    assert firsts == {0, 1, 2}
    for client in some:
        client.close()


def test_of_many_faults_eight_are_reported(server, answers):
    answers["reply"] = KeyError("oh")
    line = b'{"do": "' + b"x" * 200 + b'"}\n'
    with clients.connected(server) as client:
        client.sendall(line * 10)
        replies = clients.drain(server, client, 10)
    assert [reply["error"] for reply in replies] == [
        "a mistake of the recorder's own: KeyError('oh')"
    ] * 10
    faults = server.take_faults()
    assert faults == (f"a request failed with KeyError('oh'): {line[:80]!r}",) * 8
    assert server.requests == 10
    assert server.take_faults() == ()


def test_empty_lines_are_no_requests(server, answers):
    with clients.connected(server) as client:
        client.sendall(b"\n  \n{}\n\n")
        assert clients.drain(server, client, 1) == [{"ok": True}]
    assert (server.requests, answers["asked"]) == (1, [{}])


# -- who reads slowly, writes slowly, or waits -----------------------------------------------------


def events_of(server, index=0):
    """What the server waits for from one of its clients."""
    client = list(server._clients.values())[index]
    key = server._selector.get_map().get(client.socket)
    return 0 if key is None else key.events


def read_all(server, client, polls=300):
    """Poll some times and read each time; returns what came."""
    client.setblocking(False)
    data = b""
    for _ in range(polls):
        server.poll()
        with contextlib.suppress(BlockingIOError):
            data += client.recv(1 << 16)
    return data


def test_replies_that_the_kernel_does_not_take_at_once_are_sent_as_the_client_reads(
    server, answers
):
    answers["reply"] = {"text": "x" * 60_000}
    with clients.connected(server) as client:
        client.sendall(b"{}\n" * 20)
        for _ in range(50):
            server.poll()  # the client reads nothing meanwhile
        assert 3 < server.requests < 20
        (connection,) = server._clients.values()
        assert BUFFER <= len(connection.outgoing) <= BUFFER + 60_100
        assert events_of(server) == selectors.EVENT_WRITE
        replies = clients.replies(read_all(server, client))
        assert [len(reply["text"]) for reply in replies] == [60_000] * 20
        assert (server.requests, events_of(server)) == (20, selectors.EVENT_READ)
        assert server._selector.select(0) == []


@pytest.mark.parametrize("beyond", [0, 1])
def test_64_kib_without_an_end_are_waited_for_and_no_more(server, answers, beyond):
    with clients.connected(server) as client, contextlib.suppress(BrokenPipeError):
        client.setblocking(False)
        left = b'{"a": "' + b"x" * (BUFFER + beyond - 7)
        for _ in range(100):
            with contextlib.suppress(BlockingIOError):
                left = left[client.send(left) :]
            server.poll()
        assert left == b""
        if beyond:
            (reply,) = clients.replies(read_all(server, client, 3))
            assert (reply["ok"], reply["error"]) == (False, control.TOO_LONG)
            assert client.recv(10) == b""
        else:
            assert len(server._clients) == 1
            client.sendall(b'"}\n')
            (reply,) = clients.replies(read_all(server, client, 20))
            assert reply["error"] == control.TOO_LONG  # a line of so much and two more
            client.sendall(b"{}\n")
            assert clients.replies(read_all(server, client, 3)) == [{"ok": True}]
    assert answers["asked"] == ([] if beyond else [{}])


def test_whoever_waits_for_the_end_is_answered_last_and_only_then(server, answers):
    with clients.connected(server) as waiting, clients.connected(server) as other:
        clients.polls(server, lambda: len(server._clients) == 2)
        answers["reply"] = None
        waiting.sendall(b'{"n": 1}\n{"n": 2}\n')
        clients.polls(server, lambda: answers["asked"])
        answers["reply"] = {"a": 1}
        other.sendall(b'{"n": 3}\n')
        assert clients.replies(read_all(server, other, 20)) == [{"ok": True, "a": 1}]
        assert answers["asked"] == [{"n": 1}, {"n": 3}]
        assert read_all(server, waiting, 5) == b""
        server.close({"verdict": "good"})
        for client in (waiting, other):
            client.settimeout(clients.PATIENCE_S)
        assert clients.replies(waiting.recv(4096)) == [{"ok": True, "verdict": "good"}]
        assert (waiting.recv(9), other.recv(9)) == (b"", b"")


def test_without_a_farewell_whoever_waits_is_only_disconnected(server, answers):
    answers["reply"] = None
    with clients.connected(server) as waiting:
        waiting.sendall(b"{}\n")
        waiting.shutdown(socket.SHUT_WR)  # and is not let go for that
        for _ in range(20):
            server.poll()
        assert (len(server._clients), server.requests) == (1, 1)
        server.close()
        assert waiting.recv(9) == b""


def test_the_17th_client_replaces_the_one_that_was_silent_for_longest(server, answers):
    some = [clients.connected(server) for _ in range(MAX_CLIENTS)]
    clients.polls(server, lambda: len(server._clients) == MAX_CLIENTS)
    for k in [*range(5), *range(6, MAX_CLIENTS), 5]:  # the first of these is silent for longest
        some[k].sendall(b"{}\n")
        assert clients.drain(server, some[k], 1) == [{"ok": True}]
    for gone in (0, 1):
        some.append(clients.connected(server))
        some[-1].sendall(b"{}\n")
        assert clients.drain(server, some[-1], 1) == [{"ok": True}]
        assert len(server._clients) == MAX_CLIENTS
        some[gone].settimeout(clients.PATIENCE_S)
        (reply,) = clients.replies(some[gone].recv(4096))
        assert reply == {"ok": False, "error": "16 others are connected"}
        assert some[gone].recv(9) == b""
    for client in some:
        client.close()


def test_a_socket_that_is_gone_is_made_again_at_each_200th_poll(server):
    for _ in range(2):
        server.path.unlink()
        for _ in range(199):
            server.poll()
        assert not server.path.exists()
        server.poll()
        with clients.connected(server) as client:
            client.sendall(b"{}\n")
            assert clients.drain(server, client, 1) == [{"ok": True}]
        while server._polls % 200:
            server.poll()
