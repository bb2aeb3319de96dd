"""A real pseudo-terminal with an slcan adapter at its other end."""

import contextlib
import itertools
import os
import threading
import tty

import numpy as np
import pytest
from can.util import len2dlc

from support.can_messages import can_message, cut_at_random, fd_traffic, received, same, traffic
from support.processes import repeating, wait_for
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, FD_BRS, ID_MASK, REMOTE_FLAG
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import open_source, parse_address
from undulog.capture.sources.events import Tally
from undulog.capture.sources.slcan import STAMP_PERIOD_MS, SlcanText


def lines(frames, stamps_ms=None):
    """Frames as the protocol's description has them, and CAN FD frames as its extension does."""
    out = []
    fd = "len" in frames.dtype.names
    for number, frame in enumerate(frames):
        flags, length = int(frame["id_flags"]), int(frame["len" if fd else "dlc"])
        extended = bool(flags & EXTENDED_FLAG)
        special = bool(frame["fd_flags"] & FD_BRS if fd else flags & REMOTE_FLAG)
        letter = ("dDbB" if fd else "tTrR")[extended + 2 * special]
        identifier = f"{flags & ID_MASK:0{8 if extended else 3}X}"
        data = "" if special and not fd else bytes(frame["data"][:length]).hex().upper()
        stamp = "" if stamps_ms is None else f"{int(stamps_ms[number]) % STAMP_PERIOD_MS:04X}"
        digit = f"{len2dlc(length):X}"
        out.append(f"{letter}{identifier}{digit}{data}{stamp}\r".encode())
    return out


def stream(frames, stamps_ms=None):
    return b"".join(lines(frames, stamps_ms))


class Adapter:
    """An adapter on a pseudo-terminal: takes commands, sends when its channel is open."""

    def __init__(self, link, *, refuses=b"", answers=True):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.slave))
        self.link = link
        self.refuses, self.answers = refuses, answers
        self.commands = []
        self.opened = threading.Event()
        self.queue = b""
        self.lock = threading.Lock()
        self.plugged = True
        os.set_blocking(self.master, False)
        self.text = b""
        self.serving = contextlib.ExitStack()
        self.serving.enter_context(repeating(self.serve, 0.002))

    def send(self, data):
        with self.lock:
            self.queue += data

    def serve(self):
        with contextlib.suppress(BlockingIOError):
            self.text += os.read(self.master, 4096)
        *commands, self.text = self.text.split(b"\r")
        for command in filter(None, commands):
            self.commands.append(command)
            if self.answers:
                closed = command == b"C" and not self.opened.is_set()
                bad = closed or command[:1] == self.refuses
                os.write(self.master, b"\a" if bad else b"\r")
            if command == b"C":
                self.opened.clear()
            elif command in (b"L", b"O") and command != self.refuses:
                self.opened.set()
        with self.lock:
            if self.opened.is_set() and self.queue:
                with contextlib.suppress(BlockingIOError):
                    self.queue = self.queue[os.write(self.master, self.queue[:3000]) :]

    def unplug(self):
        if self.plugged:
            self.plugged = False
            self.serving.close()
            self.link.unlink(missing_ok=True)
            os.close(self.master)
            os.close(self.slave)


@pytest.fixture
def plug(tmp_path):
    adapters = []

    def make(**kwargs):
        adapters.append(Adapter(tmp_path / "ttyACM0", **kwargs))
        return adapters[-1]

    yield make
    for adapter in adapters:
        adapter.unplug()


def source_at(tmp_path, query="bitrate=1000000"):
    return open_source(parse_address(f"can:slcan:{tmp_path}/ttyACM0?{query}"))


@pytest.fixture
def connect(plug, listen, tmp_path):
    """Plugs an adapter in and starts its source; both."""

    def start(query="bitrate=1000000", **options):
        adapter = plug(**options)
        reader = listen(source_at(tmp_path, query))
        reader.until_event("connected")
        return adapter, reader

    return start


def commands(adapter):
    """What the adapter received, apart from closing."""
    return [command for command in adapter.commands if command != b"C"]


def test_twenty_thousand_frames_arrive_as_sent(connect):
    adapter, reader = connect()
    truth = traffic(20_000)
    assert reader.source.connected
    assert reader.source.clock is ClockDomain.HOST
    adapter.send(stream(truth))
    frames = reader.until_frames(len(truth))
    assert same(frames, truth)
    assert np.array_equal(frames["t_device_ns"], frames["t_host_ns"])
    assert (np.diff(frames["t_host_ns"].astype(np.int64)) >= 0).all()
    counts = reader.counts
    assert (counts.frames, counts.malformed, counts.dropped) == (20_000, 0, None)


def test_it_listens_only_and_never_transmits(connect):
    adapter, reader = connect()
    assert "listen-only, 1000000 bit/s" in reader.texts[-1]
    adapter.send(stream(traffic(100)))
    reader.until_frames(100)
    reader.source.stop()
    reader.until(lambda: adapter.commands[-1] == b"C")
    assert commands(adapter) == [b"S8", b"L"]
    assert reader.source.finished
    assert not reader.source.connected


def test_the_adapters_clock_runs_on_over_the_minute(connect):
    adapter, reader = connect("bitrate=500000&timestamps=1")
    truth = traffic(20_000)
    stamps_ms = 51_234 + 7 * np.arange(len(truth))
    adapter.send(stream(truth, stamps_ms))
    frames = reader.until_frames(len(truth))
    assert same(frames, truth)
    assert reader.source.clock is ClockDomain.DEVICE
    assert np.array_equal(frames["t_device_ns"], stamps_ms * 1_000_000)
    assert commands(adapter) == [b"S6", b"Z1", b"L"]


def test_minutes_of_silence_are_counted_by_the_hosts_clock():
    text, tally = SlcanText(stamps=True), Tally(lambda: 0)
    true_s = np.array([3.0, 59.9, 60.1, 700.0, 3599.999, 3600.002, 90_000.0])
    true_ms = np.rint(true_s * 1000).astype(int)
    lines = [b"t1230%04X\r" % stamp for stamp in true_ms % STAMP_PERIOD_MS]
    now_ns = [10**18 + int(s * 1e9) for s in true_s]
    blocks = [text.feed(line, t, tally)[0] for line, t in zip(lines, now_ns, strict=True)]
    assert [int(f["t_device_ns"][0]) for f in blocks] == (true_ms * 10**6).tolist()


@pytest.mark.parametrize(("asked", "given"), [(True, None), (False, np.arange(50))])
def test_stamps_that_are_missing_or_unwanted_are_no_times_and_no_data(asked, given):
    truth = traffic(50)
    frames, _ = SlcanText(stamps=asked).feed(stream(truth, given), 77, Tally(lambda: 0))
    assert same(frames, truth)
    assert set(frames["t_device_ns"].tolist()) == {77}


def test_a_recorder_that_is_held_up_loses_nothing(connect):
    adapter, reader = connect()
    truth = traffic(20_000)  # half a megabyte: several times what the terminal holds
    adapter.send(stream(truth))
    wait_for(lambda: not adapter.queue)  # nobody polls
    frames = reader.until_frames(len(truth))
    assert same(frames, truth)
    assert len(np.unique(frames["t_host_ns"])) > 5  # each stamped when it was read


def test_noise_costs_its_own_line_only(connect):
    adapter, reader = connect()
    truth = traffic(1000)
    noise = [
        b"\xff\xfe\x80\r",  # no text in any encoding
        b"t1232A\xff22\r",
        b"t12\r",
        b"t8000\r",  # identifier beyond 11 bits
        b"TFFFFFFFF0\r",  # and beyond 29
        b"t1239112233445566778899\r",  # nine bytes
        b"t1232112\r",  # a digit lost
        b"q\r",
        b"X" * 5000 + b"\r",
    ]
    places = np.random.default_rng(0).choice(1000, len(noise), replace=False).tolist()
    mixed = b""
    for number, line in enumerate(lines(truth)):
        mixed += noise[places.index(number)] if number in places else b""
        mixed += line + (b"z\r" if number % 100 == 0 else b"\r")
    adapter.send(mixed + b"\a")
    assert same(reader.until_frames(1000), truth)
    reader.until(lambda: reader.counts.malformed == len(noise) + 1)
    reader.until_event("bell")
    assert reader.counts.frames == 1000
    reader.until_event("malformed line")


def test_any_way_of_cutting_the_stream_gives_the_same():
    whole_stream = stream(traffic(300)) + b"\xff\r" + stream(traffic(300))
    whole, _ = SlcanText(stamps=False).feed(whole_stream, 5, Tally(lambda: 0))
    for seed in range(20):
        text, tally = SlcanText(stamps=False), Tally(lambda: 0)
        parts = [text.feed(piece, 5, tally)[0] for piece in cut_at_random(whole_stream, seed)]
        assert np.concatenate(parts).tobytes() == whole.tobytes()
        assert tally.counts.malformed == 1


def test_can_fd_frames_among_the_others(connect):
    adapter, reader = connect()
    truth, fd_truth = traffic(2000), fd_traffic(2000)
    mixed = itertools.chain.from_iterable(zip(lines(truth), lines(fd_truth), strict=True))
    adapter.send(b"".join(mixed) + b"d1238" + b"00" * 9 + b"\r" + b"DFFFFFFFF0\r" + b"d12\r")
    assert same(reader.until_frames(2000), truth)
    reader.until(lambda: len(reader.fd_frames) >= 2000 and reader.counts.malformed == 3)
    assert same(reader.fd_frames, fd_truth)
    assert reader.counts.frames == 4000


def test_an_adapter_stamps_can_fd_frames_too():
    truth = fd_traffic(100)
    tally = Tally(lambda: 0)
    stamped = stream(truth, 10 * np.arange(100))
    classic, frames = SlcanText(stamps=True).feed(stamped, 10**18, tally)
    assert (len(classic), tally.counts.malformed) == (0, 0)
    assert same(frames, truth)
    assert frames["t_device_ns"].tolist() == [10_000_000 * k for k in range(100)]
    assert set(frames["t_host_ns"].tolist()) == {10**18}


def test_unplugged_and_plugged_in_again(connect, plug):
    first, second = traffic(500), traffic(700)
    adapter, reader = connect()
    adapter.send(stream(first))
    reader.until_frames(500)
    adapter.unplug()
    reader.until_event("lost")
    assert not reader.source.connected
    for _ in range(100):
        reader.poll()
    adapter = plug()
    reader.until_event("is back after")
    adapter.send(stream(second))
    assert same(reader.until_frames(1200), np.concatenate([first, second]))
    assert reader.counts.reconnects == 1
    assert [event.level for event in reader.events] == ["info", "warn", "info"]
    assert not reader.source.finished


def test_an_adapter_that_is_not_there_yet_is_waited_for(plug, tmp_path, listen):
    reader = listen(source_at(tmp_path))
    assert "No such file" in reader.until_event("waits for").text
    assert not reader.source.connected
    truth = traffic(100)
    plug().send(stream(truth))
    assert same(reader.until_frames(100), truth)
    assert reader.counts.reconnects == 0


def test_an_adapter_without_listen_only_is_not_opened_otherwise(plug, tmp_path, listen):
    adapter = plug(refuses=b"L")
    assert "listen_only=0" in listen(source_at(tmp_path)).until_event("refuses").text
    assert b"O" not in adapter.commands


def test_listen_only_can_be_given_up(connect):
    adapter, reader = connect("listen_only=0", refuses=b"L")
    truth = traffic(100)
    assert "acknowledges" in reader.texts[-1]
    adapter.send(stream(truth))
    assert same(reader.until_frames(100), truth)
    assert commands(adapter) == [b"O"]


def test_an_adapter_that_never_answers(connect):
    adapter, reader = connect(answers=False)
    truth = traffic(100)
    adapter.send(stream(truth))
    assert same(reader.until_frames(100), truth)


def test_what_can_never_work_is_refused_at_once(tmp_path, context):
    (tmp_path / "ttyACM0").write_text("a file")
    with pytest.raises(SourceError, match="is no serial device"):
        source_at(tmp_path)
    with pytest.raises(SourceError, match="is no serial device"):
        open_source(parse_address("can:slcan:/dev/null")).start(context)
    for query, match in (
        ("bitrate=123", "bitrate 123 is not one of 10000, 20000"),
        ("tty_baud=5", "tty_baud 5 is not one of"),
        ("bitrat=1000000", r"no option 'bitrat'.*did you mean bitrate"),
    ):
        with pytest.raises(UsageError, match=match):
            source_at(tmp_path, query)


def test_python_cans_own_client_reads_the_same(plug, tmp_path, listen):
    pytest.importorskip("serial")
    from can.interfaces.slcan import slcanBus

    truth = traffic(1000)
    adapter = plug()
    bus = slcanBus(str(tmp_path / "ttyACM0"), bitrate=500_000, sleep_after_open=0, listen_only=True)
    # It opens twice; an answer must not split a frame.
    wait_for(lambda: adapter.commands.count(b"L") >= 2, "both openings")
    adapter.send(stream(truth))
    _, frames = received(bus, len(truth))
    bus.shutdown()
    assert same(frames, truth)
    reader = listen(source_at(tmp_path))
    reader.until_event("connected")
    adapter.send(stream(truth))
    assert same(reader.until_frames(1000), frames)


def test_can_fd_frames_as_python_cans_own_client_writes_them(plug, tmp_path):
    pytest.importorskip("serial")
    from can.interfaces.slcan import slcanBus

    truth = fd_traffic(500)
    adapter = plug(answers=False)
    bus = slcanBus(str(tmp_path / "ttyACM0"), bitrate=500_000, sleep_after_open=0)
    for frame in truth:
        bus.send(can_message(frame, error_state_indicator=False))
    bus.shutdown()

    def lines():
        return [line for line in adapter.commands if line[:1] in b"dDbB"]

    wait_for(lambda: len(lines()) >= len(truth), "all frames")
    sent = lines()
    tally = Tally(lambda: 0)
    _, frames = SlcanText(stamps=False).feed(b"\r".join(sent) + b"\r", 5, tally)
    assert tally.counts.malformed == 0
    assert same(frames, truth)
    assert same(frames, SlcanText(stamps=False).feed(stream(truth), 5, tally)[1])
