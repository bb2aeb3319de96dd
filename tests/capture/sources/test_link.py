"""A source over a connection: what openers and links may do to it, with real sockets below."""

import socket
import threading

import pytest

from support.processes import wait_for
from undulog.capture.common.errors import SourceError
from undulog.capture.log.messages.frames import FRAME_DTYPE
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import parse_address
from undulog.capture.sources.drained_link import DrainedLink
from undulog.capture.sources.link import LinkedSource
from undulog.capture.sources.reader_thread import SO_RXQ_OVFL, SO_TIMESTAMPNS
from undulog.capture.sources.socketcan import SocketcanLink

FRAME = bytes.fromhex("23010000020000001122000000000000")


def source_of(open_link):
    address = parse_address("can:test:can0")
    return LinkedSource(address, open_link, place="can0", clock=ClockDomain.HOST, facts={})


def test_a_fault_of_an_opener_is_reported_and_tried_again(sockets, listen):
    ours, theirs = sockets
    faults = [RuntimeError("a bug"), RuntimeError("a bug"), OSError(5, "Input/output error")]

    def open_link(tally):
        if faults:
            raise faults.pop(0)
        return SocketcanLink(ours, tally)

    reader = listen(source_of(open_link))
    reader.until_event("connected to can0")
    assert reader.texts == [
        "can't open can0: RuntimeError('a bug')",
        "waits for can0: Input/output error",
        "connected to can0 (never transmits)",
    ]
    theirs.send(FRAME)
    (frame,) = reader.until_frames(1)
    assert (frame["id_flags"], frame["dlc"], bytes(frame["data"][:2])) == (0x123, 2, b"\x11\x22")
    assert frame.dtype == FRAME_DTYPE


def test_a_fault_of_a_link_is_a_lost_connection(sockets, listen):
    ours, theirs = sockets

    class Faulty(SocketcanLink):
        def read(self, now_ns):
            if records := super().read(now_ns):
                raise ZeroDivisionError("a bug") from None
            return records

        def close(self):
            pass  # the test's socket lives on

    links = [Faulty, SocketcanLink]
    reader = listen(source_of(lambda tally: links.pop(0)(ours, tally)))
    reader.until_event("connected")
    theirs.send(FRAME)
    reader.until_event("lost can0: ZeroDivisionError('a bug')")
    reader.until_event("is back")
    theirs.send(FRAME)
    reader.until_frames(1)
    assert reader.counts.reconnects == 1


def test_what_the_thread_took_and_what_the_kernel_dropped_is_all(sockets, listen):
    ours, theirs = sockets
    for option in (SO_TIMESTAMPNS, SO_RXQ_OVFL):
        ours.setsockopt(socket.SOL_SOCKET, option, 1)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    reader = listen(
        source_of(lambda tally: DrainedLink(SocketcanLink(ours, tally), tally, pause_s=0.01))
    )
    reader.until_event("connected")
    sent = 3000
    for _ in range(sent):  # nobody polls, and the socket holds a few at a time
        theirs.send(FRAME)

    def send_one():
        nonlocal sent
        theirs.send(FRAME)  # drops come with the next packet
        sent += 1
        reader.poll()

    wait_for(lambda: len(reader.frames) + (reader.counts.dropped or 0) == sent, meanwhile=send_one)
    assert reader.counts.dropped
    assert reader.counts.frames == len(reader.frames)


def test_what_is_found_impossible_late_ends_the_source_only(listen):
    go = threading.Event()

    def open_link(tally):
        go.wait(60)
        raise SourceError("can:test:can0", "there is no such driver")

    reader = listen(source_of(open_link))
    assert not reader.source.finished
    go.set()
    assert reader.until_event("there is no such driver").level == "error"
    assert reader.source.finished


def test_what_is_found_impossible_at_once_is_raised(context):
    def open_link(tally):
        raise SourceError("can:test:can0", "there is no such driver")

    source = source_of(open_link)
    with pytest.raises(SourceError, match="no such driver"):
        source.start(context)
    source.stop()


def test_a_connection_that_opens_after_the_end_is_closed(sockets, context):
    ours, _ = sockets
    go = threading.Event()

    def open_link(tally):
        go.wait(60)
        return SocketcanLink(ours, tally)

    source = source_of(open_link)
    source.start(context)
    assert source.poll().frames == ()
    source.stop()
    go.set()
    wait_for(lambda: ours.fileno() == -1)
    assert not source.connected
    assert source.poll().frames == ()
