"""Links to a bus, and the ticks of a loop: what is read, sent and counted."""

import itertools
import socket

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.plain_socketcand import SOCKETCAND, plain_server
from support.processes import wait_for
from support.simulated_clock import SimulatedClock
from undulog.capture import load_robot
from undulog.capture.common.errors import SourceError
from undulog.capture.sources.contract import parse_address
from undulog.capture.sources.events import Tally
from undulog.sim.drive import links
from undulog.sim.drive.links import find_virtual_robot, sent_text
from undulog.sim.drive.loop import CommandEncoder, WallPace
from undulog.sim.drive.python_can_bus import open_link

STEP = np.radians(0.01)  # of a command on the bus of snake25


@pytest.mark.parametrize("cut", [3, 12, 40, 60, 100, 120])
def test_ticks_and_frames_stay_in_order_however_the_stream_is_cut(cut):
    answers = SOCKETCAND | {"undulog": b"< undulog virtual-robot snake25 lockstep >"}
    stream = (
        b"< tick 0 >< tick 1 >< frame 201 1.000000 0102 >< frame 202 1.000100 03 >< tick 2 >"
        b"< frame 203 1.010000 0A >"
    )
    with plain_server(answers, (stream[:cut], stream[cut:])) as (on, _):
        link = find_virtual_robot(parse_address(on), Tally(lambda: 0))
        try:
            assert (link.robot_name, link.lockstep) == ("snake25", True)
            ticks = [link.wait_tick(5.0) for _ in range(3)]
            assert [tick for tick, _ in ticks] == [0, 1, 2]
            assert [identifiers(frames) for _, frames in ticks] == [[], [], [0x201, 0x202]]
            assert link.wait_tick(0.05) is None
            wait_for(lambda: identifiers(link.receive()) == [0x203], "the frame without a tick")
        finally:
            link.close()


def test_what_python_can_can_not_read_is_counted_and_nothing_is_printed(capfd):
    stream = (
        b"< frame 201 1.000000 0102 >< frame 20",  # as its pieces of 1024 bytes end, too
        b"2 1.000100 03 >< strange >",
        b"< frame 203 1.010000 0A >",
    )
    tally = Tally(lambda: 0)
    with plain_server(SOCKETCAND, stream) as (on, _):
        bus = open_link(parse_address(f"{on}&plain=yes"), tally)
        taken = []

        def take():
            taken.extend(identifiers(bus.receive()))
            return 0x203 in taken

        wait_for(take, taken)
        bus.close()
    assert (taken, tally.counts.malformed) == ([0x201, 0x202, 0x203], 1)
    assert [event.text for event in tally.events.flush()] == ["malformed message"]
    assert capfd.readouterr() == ("", "")


def test_a_bus_that_can_not_be_opened_says_why(tmp_path):
    on = f"can:slcan:{tmp_path}/none"
    with pytest.raises(SourceError) as missing:
        open_link(parse_address(on), Tally(lambda: 0))
    assert str(missing.value).startswith(f"{on}: can't open it: ")
    with pytest.raises(SourceError) as never:  # without its driver it never can
        open_link(parse_address("can:nican:x"), Tally(lambda: 0))
    assert "can't open it" not in str(never.value)


def test_a_server_that_ends_the_connection_at_an_unknown_word_is_no_virtual_robot():
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as ours,
    ):
        theirs, _ = server.accept()
        theirs.close()
        assert links._identity(ours, b"so far") == (None, b"so far")


def identifiers(arrays):
    return [identifier for frames in arrays for identifier in frames["id_flags"].tolist()]


def test_commands_are_rounded_to_the_bus_and_sent_as_socketcand_has_them():
    robot = load_robot("snake25")
    command = np.linspace(-0.5, 0.5, 25)
    frames = CommandEncoder(robot).frames(command)
    assert frames["id_flags"].tolist() == list(range(0x101, 0x11A))
    raw = frames["data"][:, :2].copy().view("<i2")[:, 0]
    np.testing.assert_array_equal(raw, np.round(np.degrees(command) * 100))
    assert np.abs(raw * STEP - command).max() <= STEP / 2
    assert sent_text(frames[:1]) == b"< send 101 2 %02X %02X >" % tuple(frames["data"][0, :2])


class _NoBus:
    """What a pace needs of a bus: nothing comes."""

    place = "none"

    def receive(self):
        return ()


@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=30), st.lists(st.floats(0.0, 0.05)))
def test_late_ticks_are_left_out_and_counted(late_s, work_s):
    """Of 10 ms each, late by what the sleep is longer, or the work before it."""
    simulated, period_ns = SimulatedClock(), 10_000_000
    simulated.late_s += late_s
    pace, start_ns = WallPace(_NoBus(), simulated.clock), simulated.now_ns
    assert pace.next()[0] == 0
    last = left_out = 0
    for work in itertools.islice(itertools.chain(work_s, itertools.repeat(0.0)), len(late_s)):
        simulated.pass_s(work)
        due_ns = start_ns + (last + 1) * period_ns
        tick = pace.next()[0]
        assert tick == (simulated.now_ns - start_ns) // period_ns
        assert pace.late_s == pytest.approx((simulated.now_ns - due_ns) * 1e-9)
        left_out += tick - last - 1
        assert pace.overruns == left_out
        last = tick
