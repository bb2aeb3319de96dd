"""What a running recorder can be asked, and what the session has of it then."""

import math
import re

import pytest

from support.control_clients import connected, drain, polled
from support.read_back import decoded_of
from undulog.capture.common.errors import ControlError, DataError
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.recorder.control import ControlServer
from undulog.capture.recorder.control_client import ControlClient
from undulog.capture.recorder.control_requests import OPERATOR, RequestHandler

EPOCH_NS = 1_700_000_000_000_000_000


class Actions:
    """A recorder that notes what is requested of it."""

    def __init__(self):
        self.done = []

    def status(self):
        return {"output": "run.mcap", "elapsed_s": 1.5}

    def mark(self, text):
        self.done.append(("mark", text))
        return {"file": "run_mark0001.mcap"}

    def split(self):
        raise DataError("this recording has no parts")

    def stop(self):
        self.done.append(("stop",))


class Stage:
    """A server of a real session, and its clock."""

    def __init__(self, folder):
        self.path, self.actions, self.now_ns = folder / "run.mcap", Actions(), EPOCH_NS
        self.writer = SessionWriter(self.path, session_id="s", epoch_ns=EPOCH_NS)
        events = self.writer.log()
        log, now_ns = lambda *event: events.write(self.now_ns, *event), lambda: self.now_ns
        handler = RequestHandler(self.actions, self.writer, log, now_ns)
        self.server = ControlServer(folder / "c.sock", handler)

    def read(self, topic):
        """Log time and decoded message of each, by a foreign reader."""
        self.writer.close()
        return [(log_ns, content) for _, log_ns, content in decoded_of(self.path, [topic])]


@pytest.fixture
def stage(tmp_path):
    stage = Stage(tmp_path)
    yield stage
    stage.server.close()
    stage.writer.close()


@pytest.fixture
def ask(stage):
    """Sends one request of a client to the server, which is polled meanwhile."""
    with polled(stage.server, pause_s=0), ControlClient(stage.server.path) as client:
        yield lambda do, **keys: client.ask({"do": do, **keys})


def test_a_controller_s_gait_is_in_the_session_as_it_was_sent(stage, ask):
    sent = []
    for k in range(1000):
        stage.now_ns = EPOCH_NS + k * 10_000_000
        values = {"horizontal.phase": 0.1 * k, "horizontal.A": 0.4 + k / 7}
        t_ns = stage.now_ns - 3_000_001 if k % 2 else stage.now_ns
        assert ask("gait", values=values, **({"t_ns": t_ns} if k % 2 else {})) == {}
        sent.append((stage.now_ns, t_ns, values))
    messages = stage.read("/gait")
    assert len(messages) == 1000
    for (log_ns, t_ns, values), (read_ns, state) in zip(sent, messages, strict=True):
        assert dict(zip(state.name, state.position, strict=True)) == values
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == t_ns
        assert read_ns == log_ns
    assert list(messages[0][1].name) == ["horizontal.A", "horizontal.phase"]


def test_values_of_joints_and_of_a_controller_come_behind_those_of_the_planes(stage, ask):
    values = {"steer.offset": 0.1, "joint03.A": None, "horizontal.omega": 3.0, "horizontal.A": 0.4}
    ask("gait", values=values)
    ((_, state),) = stage.read("/gait")
    assert list(state.name) == ["horizontal.A", "horizontal.omega", "steer.offset", "joint03.A"]
    assert list(state.position[:3]) == [0.4, 3.0, 0.1]
    assert math.isnan(state.position[3])  # null: it has none


def test_notes_marks_and_modes_are_in_the_session(stage, ask):
    assert ask("status") == {"output": "run.mcap", "elapsed_s": 1.5}
    ask("note", text="wet sand")
    assert ask("mark", text="slipped", level="warn") == {"file": "run_mark0001.mcap"}
    ask("mark")
    ask("mode", text="walk")
    stage.now_ns += 7
    ask("mode", text="avoid")
    ask("stop")
    events = [(event.name, event.level, event.msg) for _, event in stage.read("/rosout")]
    texts = ((20, "wet sand"), (30, "mark: slipped"), (20, "mark"))
    assert events == [(OPERATOR, *text) for text in texts]
    modes = [(log_ns, mode.data) for log_ns, mode in stage.read("/gait/mode")]
    assert modes == [(EPOCH_NS, "walk"), (EPOCH_NS + 7, "avoid")]
    assert stage.actions.done == [("mark", "slipped"), ("mark", ""), ("stop",)]


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        ({}, "do: found nothing; valid: status, mark"),
        ({"do": "spilt"}, "did you mean split?"),
        ({"do": ["stop"]}, "do: found"),
        ({"do": "status", "json": True}, "json: found true; valid: status has none"),
        ({"do": "mark", "txt": "x"}, "did you mean text?"),
        ({"do": "split"}, "this recording has no parts"),
        ({"do": "stop", "wait": 1}, "wait: found 1; valid: true or false"),
        ({"do": "note"}, "text: found nothing"),
        ({"do": "note", "text": " "}, "not empty"),
        ({"do": "note", "text": "x" * 5000}, "at most 4096"),
        ({"do": "note", "text": "\0"}, "text: found"),
        ({"do": "note", "text": "\ud800"}, "text: found"),
        ({"do": "mode", "text": "\udfff"}, "text: found"),
        ({"do": "note", "text": "x", "level": "loud"}, "level: found"),
        ({"do": "gait"}, "values: found nothing"),
        ({"do": "gait", "values": {}}, "values: found a table"),
        ({"do": "gait", "values": {"vertical.omegas": 1}}, "did you mean vertical.omega?"),
        ({"do": "gait", "values": {"speed": 1}}, "others as NAME.VALUE, e.g. joint03.A"),
        ({"do": "gait", "values": {"horizontal.A": "1"}}, "values.horizontal.A: found"),
        ({"do": "gait", "values": {"horizontal.A": True}}, "a finite number"),
        ({"do": "gait", "values": {"horizontal.A": 10**400}}, "a finite number"),
        ({"do": "gait", "values": {"horizontal.A": 1}, "t_ns": 1.5}, "t_ns: found 1.5"),
        ({"do": "gait", "values": {"horizontal.A": 1}, "t_ns": 5}, "off this recorder's clock"),
        ({"do": "gait", "values": {"horizontal.A": 1}, "t_ns": -(10**30)}, "off this recorder"),
    ],
)
def test_a_wrong_request_is_answered_by_what_would_be_right(stage, ask, request_, why):
    with pytest.raises(ControlError, match=re.escape(why)):
        ask(**{"do": None} | request_)
    ask("status")
    assert stage.actions.done == []
    topics = ("/rosout", "/gait", "/gait/mode")
    assert [message for topic in topics for message in stage.read(topic)] == []


def test_an_infinite_number_is_no_gait(stage):
    with connected(stage.server) as client:
        client.sendall(b'{"do": "gait", "values": {"horizontal.A": 1e999}}\n')
        (reply,) = drain(stage.server, client, 1)
        assert "a finite number" in reply["error"]


def test_other_names_than_at_first_are_refused_and_the_first_go_on(stage, ask):
    ask("gait", values={"horizontal.A": 1.0})
    with pytest.raises(ControlError, match="the names that this session's gait began"):
        ask("gait", values={"horizontal.A": 1.0, "vertical.A": 2.0})
    ask("gait", values={"horizontal.A": 3.0})
    assert [state.position[0] for _, state in stage.read("/gait")] == [1.0, 3.0]


def test_a_gait_that_a_source_writes_is_not_taken_from_outside(stage, ask):
    stage.writer.joint_state("/gait", ["horizontal.A"], unit="rad")
    with pytest.raises(ControlError, match="/gait is open already"):
        ask("gait", values={"horizontal.A": 1.0})
