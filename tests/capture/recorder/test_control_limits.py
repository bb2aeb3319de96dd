"""The control socket at its limits: longest requests and replies, turns of the clients, faults."""

import json

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
