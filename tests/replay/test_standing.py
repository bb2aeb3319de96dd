"""Viewers and analyses that stand still: given up within the limit, with a sentence."""

import numpy as np
import pytest
import rerun as rr

from support.processes import alive, freeze, process, wait_for
from undulog.capture.common.errors import NoAnswerError
from undulog.capture.common.process import StopRequest
from undulog.capture.common.waits import Standstill
from undulog.replay import progressive, viewer
from undulog.replay.numbers import Analysing
from undulog.replay.viewer import Viewer, client_of, free_ports, viewer_binary


@pytest.fixture
def frozen(tmp_path):
    """A Rerun process that takes data, and is frozen once it listens."""
    with Viewer(["--save", str(tmp_path / "taken.rrd")]) as running:
        running.wait_until_it_listens()
        yield running


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_viewer_that_takes_nothing_is_given_up(frozen, monkeypatch):
    monkeypatch.setattr(progressive, "TAKES_S", 2.0)
    sink = progressive._Sink(frozen, StopRequest())
    rec = sink.open("frozen")
    rec.connect_grpc(frozen.address)
    rec.log("before", rr.TextLog("before"))
    sink.hand_over(rec)
    freeze(frozen._process.pid)
    pixels = np.random.default_rng(1).integers(0, 255, (1000, 1000, 3), "uint8")
    for _ in range(20):  # more than the sockets hold
        rec.log("picture", rr.Image(pixels))
    with pytest.raises(NoAnswerError, match=r"the Rerun viewer did not answer within 2 s; "):
        sink.hand_over(rec)
    frozen.close()
    rec.disconnect()


@pytest.mark.slow
def test_a_viewer_that_answers_nothing_is_given_up(monkeypatch):
    monkeypatch.setattr(viewer, "_START_S", 3.0)
    (port,) = free_ports(1)
    words = (viewer_binary(), "--serve-grpc", "--bind", "127.0.0.1", "--port", port)
    with process(*words) as running:
        wait_for(lambda: viewer._listens(port), "the server")
        freeze(running.pid)
        with pytest.raises(NoAnswerError, match=r"the Rerun viewer did not answer within 3 s; "):
            client_of(f"rerun+http://127.0.0.1:{port}/proxy")


@pytest.mark.slow
def test_an_analysis_that_stands_still_is_ended_and_noted(session_file):
    topics = ("/joint_commands", "/joint_states")
    with Analysing(session_file, topics) as analysing:
        analysing.start()
        pid = analysing._process.pid
        freeze(pid)
        analysing._still = Standstill(1.0)
        layer = wait_for(lambda: analysing.layer, "the note")
        assert layer.analysis is None
        assert "the analysis computed nothing" in layer.notes[0]
        assert not alive(pid)
