"""Recorders and relays on one socket."""

from contextlib import ExitStack

import pytest

from support.live_stage import Recorder, Relay
from undulog.capture.recorder import live_feed


@pytest.fixture(scope="module", autouse=True)
def small_datagrams():
    """Sent after 2 ms rather than 20, so that sending takes no time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_feed, "_FILL_NS", 2_000_000)
        yield


@pytest.fixture
def stage(tmp_path, session_file):
    """Makes recorders and relays on one socket; none of them is left."""
    socket_path = tmp_path / "live.sock"
    with ExitStack() as stack:

        class Stage:
            path = socket_path

            @staticmethod
            def recorder(session=session_file):
                recorder = Recorder(session, socket_path)
                stack.callback(recorder.feed.close)
                return recorder

            @staticmethod
            def relay(name="live.rrd", *more):
                relay = Relay(socket_path, tmp_path / name if name else None, *more)
                stack.callback(relay.process.communicate)
                stack.callback(relay.process.kill)
                return relay

        yield Stage
