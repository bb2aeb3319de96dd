"""Telling a recorder the gait: through a real control socket, and what follows when it goes."""

from contextlib import contextmanager

import numpy as np
import pytest

from support.control_clients import polled
from support.processes import wait_for
from undulog.capture.common.errors import ControlError
from undulog.capture.recorder.control import ControlServer
from undulog.sim.drive.session import GaitPublisher
from undulog.sim.gait.contract import GaitTick

NAMES = tuple(f"horizontal.{key}" for key in ("A", "omega", "lag", "offset", "phase"))


def tick(k, mode="walk", count=5):
    return GaitTick(np.zeros(25), np.arange(count) + float(k), mode, ())


@contextmanager
def control_socket(path, refuse=()):
    """A recorder's control socket that keeps the requests."""
    received = []

    def handle(request):
        received.append(dict(request))
        if request["do"] in refuse:
            raise ControlError("a source writes that topic")
        return {}

    server = ControlServer(path, handle)
    try:
        with polled(server):
            yield received
    finally:
        server.close()


@contextmanager
def publishing(path, names=NAMES, **options):
    """A publisher of a gait and the requests that its recorder received."""
    with control_socket(path, **options) as received:
        teller = GaitPublisher(path, names)
        yield teller, received
        teller.close()


def test_everything_is_published_in_order(tmp_path):
    with publishing(tmp_path / "a.sock") as (teller, received):
        teller.note("drives")
        for k in range(300):
            teller.publish(tick(k, "walk" if k < 200 else "avoid"), 10**18 + k)
    assert (teller.taken, teller.dropped, teller.error) == (300, 0, None)
    gait = [request for request in received if request["do"] == "gait"]
    assert [request["t_ns"] - 10**18 for request in gait] == list(range(300))
    assert gait[7]["values"] == dict(zip(NAMES, [7.0, 8.0, 9.0, 10.0, 11.0], strict=True))
    assert [
        (received.index(message), message) for message in received if message["do"] != "gait"
    ] == [
        (0, {"do": "note", "text": "drives", "level": "info"}),
        (1, {"do": "mode", "text": "walk"}),
        (202, {"do": "mode", "text": "avoid"}),
    ]


def test_what_json_has_no_number_for_is_null(tmp_path):
    names = (*NAMES, "joint01.A", "steer.distance")
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0, np.nan, np.inf])
    with publishing(tmp_path / "a.sock", names) as (teller, received):
        teller.publish(GaitTick(np.zeros(25), values, "walk", ()), 1)
    expected = [1.0, 2.0, 3.0, 4.0, 5.0, None, None]
    assert received[-1]["values"] == dict(zip(names, expected, strict=True))


def test_commands_without_a_gait_publish_their_mode_only(tmp_path):
    with publishing(tmp_path / "a.sock", ()) as (teller, received):
        teller.publish(tick(0, "replay", count=0), 1)
    assert (received, teller.taken) == ([{"do": "mode", "text": "replay"}], 0)


def test_a_recorder_that_goes_or_refuses_is_sent_nothing_more(tmp_path):
    with control_socket(tmp_path / "a.sock"):
        teller = GaitPublisher(tmp_path / "a.sock", NAMES)
        teller.publish(tick(0), 1)
        wait_for(lambda: teller.taken == 1)
    for k in range(5000):  # more than is held: nothing waits, nothing fails
        teller.publish(tick(k), k)
    teller.close()
    assert teller.taken == 1
    assert "went" in teller.error
    with publishing(tmp_path / "b.sock", refuse=("gait",)) as (teller, _):
        teller.publish(tick(0), 1)
    assert (teller.taken, teller.error) == (0, "a source writes that topic")


def test_no_recorder_there_is_an_error(tmp_path):
    with pytest.raises(ControlError, match="no recorder listens there"):
        GaitPublisher(tmp_path / "none.sock", NAMES)
