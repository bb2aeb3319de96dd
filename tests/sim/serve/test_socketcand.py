"""The socketcand server, with python-can's client and our own source as its peers."""

import socket
import threading
from contextlib import ExitStack, contextmanager

import can
import numpy as np
import pytest
from can.interfaces.socketcand.socketcand import (
    convert_ascii_message_to_can_message,
    convert_can_message_to_ascii_message,
)
from hypothesis import given
from hypothesis import strategies as st

from support.can_messages import can_message, frames_of, received, same, traffic
from support.processes import repeating, wait_for
from undulog.capture import SessionWriter
from undulog.capture.common.errors import UsageError
from undulog.capture.log.messages.frames import (
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    REMOTE_FLAG,
    empty_frames,
)
from undulog.capture.recorder.status import SessionClock
from undulog.capture.sources.contract import SourceContext, open_source, parse_address, records
from undulog.capture.sources.events import Tally
from undulog.capture.sources.socketcand import SocketcandText
from undulog.sim.drive.links import find_virtual_robot
from undulog.sim.serve import socketcand_server
from undulog.sim.serve.socketcand_protocol import ClientText, frame_text, sent_frame

PATIENCE_S = 60.0


class Serving:
    """A bus whose clients are served by a thread; its robot is the test."""

    def __init__(self):
        self.events = []
        self.server = socketcand_server.SocketcandServer(
            "localhost", 0, "can0", lambda level, text: self.events.append((level, text))
        )
        self.port = self.server.address[1]
        self.bus = socketcand_server.VirtualBus(self.server, None, lambda *_: None)
        self.lock = threading.Lock()
        self.pulling = True
        self.pulled = []
        self.serving = ExitStack()
        self.serving.enter_context(repeating(self.serve, 0.0005))

    def serve(self):
        with self.lock:
            self.bus.wait(0.0)
            if self.pulling and (sent := self.bus.pull()):
                self.pulled.append(self.bus.relay(sent, 12_345_678_000))

    def send(self, frames):
        with self.lock:
            self.bus.send(frames)

    def frames(self):
        return np.concatenate([empty_frames(0), *self.pulled])

    def raw(self):
        with self.lock:
            return sum(client.raw for client in self.server._clients.values())

    def close(self):
        self.serving.close()
        self.bus.close()


@pytest.fixture
def serving():
    made = Serving()
    yield made
    made.close()


def peer(serving):
    return can.Bus(interface="socketcand", host="127.0.0.1", port=serving.port, channel="can0")


@contextmanager
def hand(serving, *words):
    """A client by hand; what it asked for has been answered when the block begins."""
    with socket.create_connection(("127.0.0.1", serving.port)) as sock:
        sock.settimeout(PATIENCE_S)
        assert read_until(sock, b"< hi >") == b"< hi >"
        for word in words:
            sock.sendall(b"< %s >" % word)
            assert read_until(sock, b"< ok >") == b"< ok >"
        yield sock


def read_until(sock, end):
    data = b""
    while not data.endswith(end):
        chunk = sock.recv(65536)
        if not chunk:
            return data
        data += chunk
    return data


# -- text ------------------------------------------------------------------------------------


def test_what_the_server_writes_both_clients_read_alike():
    truth = traffic(500, 0)
    text = frame_text(truth)
    tally = Tally(lambda: 0)
    decoded = SocketcandText().feed(text, 5, tally)
    assert same(decoded, truth)
    assert np.array_equal(decoded["t_device_ns"], truth["t_device_ns"])
    pieces = [piece + ">" for piece in text.decode().split(">")[:-1]]
    assert same(frames_of([convert_ascii_message_to_can_message(piece) for piece in pieces]), truth)
    odd = empty_frames(2)
    odd["id_flags"] = [ERROR_FLAG | 0x40, REMOTE_FLAG | 0x123]
    odd["dlc"] = [8, 3]
    assert frame_text(odd) == b"< error 040 0.000000 >< rtr 123 0.000000 3 >"
    assert SocketcandText().feed(frame_text(odd), 5, tally)["id_flags"].tolist() == (
        odd["id_flags"].tolist()
    )
    assert tally.counts.malformed == 0


@given(st.integers(0, 2**29 - 1), st.booleans(), st.binary(max_size=8))
def test_what_python_can_sends_is_read(identifier, extended, data):
    identifier &= 0x1FFFFFFF if extended else 0x7FF
    message = can.Message(arbitration_id=identifier, is_extended_id=extended, data=data)
    (text,) = ClientText().feed(convert_can_message_to_ascii_message(message).encode())
    word, _, rest = text.partition(" ")
    record = sent_frame(word, rest.strip())
    assert record is not None
    assert same(records([record]), frames_of([message]))
    assert records([record])["dir"].tolist() == [DIR_TX]


BROKEN = ["", "123", "123 1", "123 9 1 2 3 4 5 6 7 8 9", "800 0", "20000000 0", "1 1 100", "x 0"]


@pytest.mark.parametrize("rest", [*BROKEN, "1 0 1"])
def test_broken_frames_are_no_frames(rest):
    assert sent_frame("send", rest) is None


def test_remote_requests_have_a_length_and_no_data():
    record = sent_frame("sendrtr", "1AAAAAAA 2")
    assert record is not None
    (frame,) = records([record])
    fields = frame["id_flags"], frame["dlc"], frame["data"].any()
    assert fields == (0x1AAAAAAA | EXTENDED_FLAG | REMOTE_FLAG, 2, False)
    assert sent_frame("sendrtr", "123 1 22") is None


# -- peers -----------------------------------------------------------------------------------


def test_frames_go_to_everyone_but_their_sender(serving):
    ours, other = traffic(300, 0), traffic(200, 0)
    with peer(serving) as first, peer(serving) as second:
        wait_for(lambda: serving.raw() == 2, "two clients")
        serving.send(ours)
        assert same(received(first, 300)[1], ours)
        assert same(received(second, 300)[1], ours)
        for frame in other:
            first.send(can_message(frame))
        messages, frames = received(second, 200)
        assert same(frames, other)
        assert {message.timestamp for message in messages} == {12.345678}
        wait_for(lambda: len(serving.frames()) == 200, "all frames at the robot")
        assert same(serving.frames(), other)
        assert first.recv(0.2) is None


def test_our_own_source_records_the_bus(serving, tmp_path):
    ours, other = traffic(300, 0), traffic(100, 0)
    source = open_source(parse_address(f"can:socketcand:can0?port={serving.port}"))
    clock = SessionClock()
    with SessionWriter(tmp_path / "x.mcap", session_id="s", epoch_ns=clock.epoch_ns) as writer:
        source.start(SourceContext(clock.now_ns, writer))
        try:
            wait_for(lambda: serving.raw() == 1, "our source")
            arrays = []
            serving.send(ours)
            with peer(serving) as foreign:
                for frame in other:
                    foreign.send(can_message(frame))

                def enough():
                    arrays.extend(source.poll().frames)
                    return sum(map(len, arrays)) >= 400

                wait_for(enough, "all frames")
        finally:
            source.stop()
    recorded = np.concatenate(arrays)
    assert same(recorded, np.concatenate([ours, other]))
    assert np.array_equal(recorded["t_device_ns"][:300], ours["t_device_ns"])
    assert source.counts.malformed == 0


def test_pythons_client_can_join_a_busy_bus(serving):
    ours = traffic(20, 0)
    with repeating(lambda: serving.send(ours), 0.001):
        for _ in range(10):
            with peer(serving) as bus:
                assert bus.recv(PATIENCE_S) is not None


# -- manners ---------------------------------------------------------------------------------


def test_answers_are_those_of_the_protocol(serving):
    with hand(serving, b"open can0") as sock:
        for request, answer in (
            (b"echo", b"< echo >"),
            (b"bcmmode", b"< ok >"),
            (b"subscribe 0 0 123", b"< error only the raw mode is served >"),
            (b"statistics 100", b"< error unknown command >"),
            (b"send 123 2 11", b"< error syntax error >"),
        ):
            sock.sendall(b"< %s >" % request)
            assert read_until(sock, b">") == answer
        sock.sendall(b"< send 123 1 A >")  # without the raw mode one can send, too
        wait_for(lambda: len(serving.pulled), "the frame")
    for request in (b"< send 123 1 A >", b"< open can7 >"):
        with hand(serving) as sock:
            sock.sendall(request)
            assert read_until(sock, b">") == b"< error could not open bus >"
            assert sock.recv(10) == b""
    wait_for(
        lambda: any("there is only can0" in text for _, text in serving.events),
        "can7 refused",
    )


@pytest.mark.slow
def test_a_client_that_does_not_listen_is_let_go_and_the_others_hear_all(serving):
    ours = traffic(1000, 0)
    with hand(serving, b"open can0", b"rawmode"), peer(serving) as good:
        wait_for(lambda: serving.raw() == 2, "two clients")
        sent = 0
        while not serving.server.dropped:
            serving.send(ours)
            sent += 1000
            assert len(received(good, 1000)[1]) == 1000
            assert sent < 2_000_000
    warnings = [text for level, text in serving.events if level == "warn"]
    assert len(warnings) == 1
    assert "does not take its frames" in warnings[0]


def test_a_client_that_makes_no_sense_is_let_go(serving):
    with hand(serving) as sock:
        sock.sendall(b"<" + b"A" * 1000)
        assert sock.recv(10) == b""
    assert serving.server.dropped == 1


@pytest.mark.slow
def test_who_sends_more_than_the_robot_takes_has_to_wait_and_loses_nothing(serving):
    with serving.lock:
        serving.pulling = False
    many = traffic(60_000, 0)
    text = "".join(convert_can_message_to_ascii_message(can_message(frame)) for frame in many)
    with hand(serving, b"open can0") as sock:
        thread = threading.Thread(target=sock.sendall, args=(text.encode(),))
        thread.start()
        wait_for(lambda: serving.bus.waiting >= socketcand_server.MOST_SENT, "a full queue")
        for _ in range(20):
            with serving.lock:
                serving.bus.wait(0.0)
        assert serving.bus.waiting < socketcand_server.MOST_SENT + 2000
        with serving.lock:
            serving.pulling = True
        wait_for(lambda: sum(map(len, serving.pulled)) == len(many), "all frames")
        thread.join()
    assert same(serving.frames(), many)


def test_commands_that_the_robot_has_not_read_survive_the_end_of_the_connection(
    serving, monkeypatch
):
    monkeypatch.setattr(socketcand_server, "HOLD_S", 0.0)
    ours = traffic(40, 0)
    with serving.lock:
        serving.pulling = False
        serving.server.identity = "virtual-robot snake25 paced"
        serving.server.mark(0)
    address = parse_address(f"can:socketcand:can0?port={serving.port}")
    link = find_virtual_robot(address, Tally(lambda: 0))
    with serving.lock:  # the robot does not listen
        # It sent more than the controller has read, so that the end resets the connection; and it
        # sends again before it listens.
        serving.server.broadcast(ours)
        link.send(ours)
        link.close()
        for _ in range(3):
            serving.server.broadcast(ours)
        assert serving.server.waiting == 0
    wait_for(lambda: not any(c.bus_open for c in serving.server._clients.values()))
    assert same(records(command.record for command in iter(serving.server.take, None)), ours)
    link.close()  # again, and nothing happens


def test_no_more_clients_than_there_is_room_for(serving):
    with ExitStack() as clients:
        for _ in range(socketcand_server.MOST_CLIENTS):
            clients.enter_context(hand(serving, b"open can0", b"rawmode"))
        with socket.create_connection(("127.0.0.1", serving.port)) as late:
            late.settimeout(PATIENCE_S)
            assert late.recv(10) == b""


@pytest.mark.parametrize("words", [(), (b"open can0",)], ids=["nothing", "open"])
def test_silent_clients_lock_nobody_out(serving, words):
    """Whoever connects and stays silent gives way; who works on the bus stays."""
    frames = traffic(50, 0)
    with ExitStack() as clients:
        worker = clients.enter_context(hand(serving, b"open can0", b"rawmode"))
        for _ in range(3 * socketcand_server.MOST_CLIENTS):
            clients.enter_context(hand(serving, *words))
        late = clients.enter_context(peer(serving))
        wait_for(lambda: serving.raw() == 2, "both in raw mode")
        serving.send(frames)
        _, heard = received(late, len(frames))
        text = frame_text(frames)
        assert read_until(worker, text[-40:]) == text
    assert same(heard, frames)


def test_only_loopback_is_served():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for host, at, why in (
            ("0.0.0.0", 0, "is not this computer's loopback"),
            ("192.0.2.1", 0, "is not this computer's loopback"),
            ("no.such.host.invalid", 0, "no address to serve at"),
            ("127.0.0.1", port, f"can't serve at 127.0.0.1:{port}: Address already"),
        ):
            with pytest.raises(UsageError, match=why):
                socketcand_server.SocketcandServer(host, at, "can0", lambda *_: None)
