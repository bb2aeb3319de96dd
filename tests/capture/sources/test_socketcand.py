"""A real socketcand server over TCP, read by us and by python-can's own client."""

import socket
import sys
import threading

import can
import numpy as np
import pytest

from support.can_messages import cut_at_random, received, same, traffic
from support.processes import start
from undulog.capture.common.errors import UsageError
from undulog.capture.log.messages.frames import ERROR_FLAG, EXTENDED_FLAG, ID_MASK, REMOTE_FLAG
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import open_source, parse_address
from undulog.capture.sources.events import Tally
from undulog.capture.sources.socketcand import SocketcandText


def messages(frames, blank=""):
    """Frames as socketcand writes them, remote requests among them."""
    out = []
    for frame in frames:
        flags, length, t_ns = (int(frame[key]) for key in ("id_flags", "dlc", "t_device_ns"))
        identifier = f"{flags & ID_MASK:0{8 if flags & EXTENDED_FLAG else 3}X}"
        stamp = f"{t_ns // 10**9}.{t_ns % 10**9 // 1000:06d}"
        if flags & REMOTE_FLAG:
            out.append(f"< rtr {identifier} {stamp} {length} >")
        else:
            data = blank.join(f"{byte:02X}" for byte in frame["data"][:length].tolist())
            out.append(f"< frame {identifier} {stamp} {data} >")
    return "".join(out).encode()


class Server:
    """Serves a stream to each client that asks for can0 in raw mode."""

    def __init__(self, port=0, hello=b"< hi >", go=None):
        self.listener = socket.create_server(("127.0.0.1", port))
        self.port = self.listener.getsockname()[1]
        self.hello, self.go = hello, go
        self.stream = b""
        self.pieces = []
        self.requests = []
        self.clients = []
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self):
        while True:
            try:
                client, _ = self.listener.accept()
            except OSError:
                return
            client.settimeout(60)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.clients.append(client)
            try:
                self.serve(client)
            except OSError:
                continue

    def serve(self, client):
        client.sendall(self.hello)
        for expected in (b"< open can0 >", b"< rawmode >"):
            self.requests.append(client.recv(1000))
            if self.requests[-1] != expected:
                client.sendall(b"< error could not open bus >")
                return
            client.sendall(b"< ok >")
        if self.go is not None:
            self.go.wait()
        at = 0
        for size in [*self.pieces, len(self.stream)]:
            client.sendall(self.stream[at : at + size])
            at += size

    def close(self):
        self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        for client in self.clients:
            client.close()
        self.thread.join()


@pytest.fixture
def serve():
    servers = []

    def make(*args, **kwargs):
        servers.append(Server(*args, **kwargs))
        return servers[-1]

    yield make
    for server in servers:
        if server.thread.is_alive():
            server.close()


def source_at(port, channel="can0"):
    return open_source(parse_address(f"can:socketcand:{channel}?host=127.0.0.1&port={port}"))


@pytest.mark.parametrize("blank", ["", " "])
def test_many_frames_and_their_times_to_the_microsecond(serve, listen, blank):
    truth = traffic(20_000)
    server = serve()
    server.stream = messages(truth, blank)
    server.pieces = np.random.default_rng(1).integers(1, 3000, 400).tolist()
    reader = listen(source_at(server.port))
    frames = reader.until_frames(len(truth))
    assert same(frames, truth)
    assert np.array_equal(frames["t_device_ns"], truth["t_device_ns"])
    assert reader.source.clock is ClockDomain.DEVICE
    assert reader.counts.malformed == 0
    assert server.requests == [b"< open can0 >", b"< rawmode >"]


def test_python_cans_own_client_reads_the_same(serve, listen):
    truth = traffic(20_000, remote_share=0)  # it has no remote requests
    server = serve(go=threading.Event())  # it can't bear frames right behind the last answer
    server.stream = messages(truth)
    bus = can.Bus(interface="socketcand", host="127.0.0.1", port=server.port, channel="can0")
    server.go.set()
    theirs, frames = received(bus, len(truth))
    bus.shutdown()
    parsed = listen(source_at(server.port)).until_frames(len(truth))
    assert same(parsed, frames)
    assert (
        np.abs(parsed["t_device_ns"] / 1e9 - np.array([m.timestamp for m in theirs])).max() < 1e-6
    )


def test_error_frames_are_frames_and_events(serve, listen):
    truth = traffic(10)
    server = serve()
    faults = b"< error 040 1700000001.000001 >< error 020 1700000001.000002 >"
    server.stream = messages(truth[:5]) + faults + messages(truth[5:])
    reader = listen(source_at(server.port))
    frames = reader.until_frames(12)
    errors = frames[5:7]
    assert errors["id_flags"].tolist() == [ERROR_FLAG | 0x40, ERROR_FLAG | 0x20]
    assert errors["t_device_ns"].tolist() == [1700000001000001000, 1700000001000002000]
    assert same(np.delete(frames, [5, 6]), truth)
    assert reader.counts.error_frames == 2
    events = {(event.level, event.text) for event in reader.events[1:]}
    left, lone = "bus-off: the controller left the bus", "error frame: no acknowledgement"
    assert events >= {("error", left), ("warn", lone)}
    reader.until_frames(12)
    server.stream = b""
    convert = can.interfaces.socketcand.socketcand.convert_ascii_message_to_can_message
    theirs = convert("< error 040 1700000001.000001 >")
    assert theirs.is_error_frame
    assert theirs.arbitration_id == int(errors["id_flags"][0]) & ID_MASK


def test_any_way_of_cutting_the_stream_gives_the_same():
    truth = traffic(200)
    stream = messages(truth) + b"< frame 12Z 1.0 00 >" + messages(truth, " ") + b"< ok >"
    whole = SocketcandText().feed(stream, 5, Tally(lambda: 0))
    assert len(whole) == 400
    for seed in range(20):
        text, tally = SocketcandText(), Tally(lambda: 0)
        parts = [text.feed(piece, 5, tally) for piece in cut_at_random(stream, seed)]
        assert np.concatenate(parts).tobytes() == whole.tobytes()
        assert tally.counts.malformed == 1


def test_noise_costs_its_own_message_only():
    truth = traffic(1000)
    noise = [
        b"< frame 123 1.000000 11",  # cut short: the next one begins
        b"ame 123 1.000000 11 >",  # its beginning lost
        b"< frame FFF 1.000000 11 >",  # beyond 11 bits
        b"< frame 123 1.000000 1 >",  # half a byte
        b"< frame 123 x.000000 11 >",
        b"< frame \xff\xfe 1.000000 11 >",
        b"< what >",
        b"<" + b"Y" * 5000 + b">",
    ]
    good = [messages(truth[k : k + 1]) for k in range(1000)]
    for number, piece in enumerate(noise):
        good[100 * number + 50] = piece + good[100 * number + 50]
    text, tally = SocketcandText(), Tally(lambda: 0)
    stream = b"".join(good)
    parts = [text.feed(stream[k : k + 1400], 5, tally) for k in range(0, len(stream), 1400)]
    assert same(np.concatenate(parts), truth)
    assert tally.counts.malformed == len(noise)


def test_other_decimals_and_other_widths():
    text, tally = SocketcandText(), Tally(lambda: 0)
    stream = b"< frame 7 23.4 11 >< frame 123 23.424242 >< frame 00000123 5.123456789 1122 >"
    frames = text.feed(stream, 5, tally)
    assert frames["t_device_ns"].tolist() == [23_400_000_000, 23_424_242_000, 5_123_456_789]
    assert frames["id_flags"].tolist() == [7, 0x123, 0x123 | EXTENDED_FLAG]
    assert frames["dlc"].tolist() == [1, 0, 2]
    assert tally.counts.malformed == 0


def test_a_time_out_of_range_is_replaced_by_the_arrivals_and_counted():
    tally = Tally(lambda: 0)
    times = ("-1.5", "nan", "-inf", "1e300", "99999999999.0", "9" * 300, "5.5")
    stream = "".join(f"< frame 123 {time_s} 11 >< rtr 123 {time_s} 3 >" for time_s in times)
    frames = SocketcandText().feed(stream.encode(), 77, tally)
    assert frames["t_device_ns"].tolist() == [77] * 2 * 6 + [5_500_000_000] * 2
    assert tally.counts.malformed == 12


def test_can_fd_frames_are_left_out_and_counted():
    truth = traffic(3)
    tally = Tally(lambda: 0)
    stream = messages(truth) + b"< frame 123 1.000000 " + b"AB" * 12 + b" >"
    assert same(SocketcandText().feed(stream, 5, tally), truth)
    assert [event.text for event in tally.events.take()] == ["CAN FD frame left out"]
    assert tally.counts.malformed == 0


KILLED = """
import socket, sys, time
server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
print(server.getsockname()[1], flush=True)
client, _ = server.accept()
client.sendall(b"< hi >")
client.recv(100)
client.sendall(b"< ok >")
client.recv(100)
client.sendall(b"< ok >" + sys.argv[2].encode())
time.sleep(600)
"""


def test_the_server_is_killed_and_comes_back(listen):
    first, second = traffic(100), traffic(200)
    with start(sys.executable, "-c", KILLED, 0, messages(first).decode()) as process:
        port = int(process.stdout.readline())
        reader = listen(source_at(port))
        reader.until_frames(100)
        process.kill()
        reader.until_event("lost can0 at 127.0.0.1")
    assert not reader.source.connected
    for _ in range(100):
        reader.poll()
    with start(sys.executable, "-c", KILLED, port, messages(second).decode()) as process:
        assert same(reader.until_frames(300), np.concatenate([first, second]))
        process.kill()
    assert reader.counts.reconnects == 1
    assert [event.level for event in reader.events][:3] == ["info", "warn", "info"]
    reader.until_event("is back after")


def test_a_server_that_comes_later(listen, serve):
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        port = reserved.getsockname()[1]
    reader = listen(source_at(port))
    assert "Connection refused" in reader.until_event("waits for").text
    truth = traffic(50)
    serve(port).stream = messages(truth)
    assert same(reader.until_frames(50), truth)


def test_something_else_at_the_port_or_another_bus_is_reported(listen, serve):
    reader = listen(source_at(serve(hello=b"HTTP/1.1 400 >").port))
    assert "HTTP" in reader.until_event("waits for").text
    reader = listen(source_at(serve().port, "can7"))
    assert "could not open bus" in reader.until_event("waits for").text


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ("port=x", "port=x is not a whole number"),
        ("port=70000", "port 70000 is not one of"),
        ("hots=x", "no option 'hots'; valid: host, port"),
    ],
)
def test_options_are_checked(options, match):
    with pytest.raises(UsageError, match=match):
        open_source(parse_address(f"can:socketcand:can0?{options}"))
