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
    heard = []

    def handle(request):
        heard.append(dict(request))
        if request["do"] in refuse:
            raise ControlError("a source writes that topic")
        return {}

    server = ControlServer(path, handle)
    try:
        with polled(server):
            yield heard
    finally:
        server.close()


def test_everything_is_told_in_order(tmp_path):
    with control_socket(tmp_path / "a.sock") as heard:
        teller = GaitPublisher(tmp_path / "a.sock", NAMES)
        teller.note("drives")
        for k in range(300):
            teller.publish(tick(k, "walk" if k < 200 else "avoid"), 10**18 + k)
        teller.close()
    assert (teller.taken, teller.dropped, teller.error) == (300, 0, None)
    gait = [request for request in heard if request["do"] == "gait"]
    assert [request["t_ns"] - 10**18 for request in gait] == list(range(300))
    assert gait[7]["values"] == dict(zip(NAMES, [7.0, 8.0, 9.0, 10.0, 11.0], strict=True))
    others = [(heard.index(one), one) for one in heard if one["do"] != "gait"]
    assert others == [
        (0, {"do": "note", "text": "drives", "level": "info"}),
        (1, {"do": "mode", "text": "walk"}),
        (202, {"do": "mode", "text": "avoid"}),
    ]


def test_what_json_has_no_number_for_is_null(tmp_path):
    names = (*NAMES, "joint01.A", "steer.distance")
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0, np.nan, np.inf])
    with control_socket(tmp_path / "a.sock") as heard:
        teller = GaitPublisher(tmp_path / "a.sock", names)
        teller.publish(GaitTick(np.zeros(25), values, "walk", ()), 1)
        teller.close()
    told = [1.0, 2.0, 3.0, 4.0, 5.0, None, None]
    assert heard[-1]["values"] == dict(zip(names, told, strict=True))


def test_commands_without_a_gait_tell_their_mode_only(tmp_path):
    with control_socket(tmp_path / "a.sock") as heard:
        teller = GaitPublisher(tmp_path / "a.sock", ())
        teller.publish(tick(0, "replay", count=0), 1)
        teller.close()
    assert heard == [{"do": "mode", "text": "replay"}]
    assert teller.taken == 0


def test_a_recorder_that_goes_or_refuses_is_told_nothing_more(tmp_path):
    with control_socket(tmp_path / "a.sock"):
        teller = GaitPublisher(tmp_path / "a.sock", NAMES)
        teller.publish(tick(0), 1)
        wait_for(lambda: teller.taken == 1)
    for k in range(5000):  # more than is held: nothing waits, nothing fails
        teller.publish(tick(k), k)
    teller.close()
    assert teller.taken == 1
    assert "went" in teller.error
    with control_socket(tmp_path / "b.sock", refuse=("gait",)):
        teller = GaitPublisher(tmp_path / "b.sock", NAMES)
        teller.publish(tick(0), 1)
        teller.close()
    assert (teller.taken, teller.error) == (0, "a source writes that topic")


def test_no_recorder_there_is_an_error(tmp_path):
    with pytest.raises(ControlError, match="no recorder listens there"):
        GaitPublisher(tmp_path / "none.sock", NAMES)
