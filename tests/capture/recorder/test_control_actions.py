"""What a running recorder can be asked, and what the session has of it then."""

import math

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from support.control_clients import connected, drain, polled
from undulog.capture.common.errors import ControlError, DataError
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.recorder.control import ControlServer
from undulog.capture.recorder.control_client import ControlClient
from undulog.capture.recorder.control_requests import OPERATOR, RequestHandler

EPOCH_NS = 1_700_000_000_000_000_000


class Actions:
    """A recorder that notes what it is told to do."""

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


@pytest.fixture
def session(tmp_path):
    """A server of a real session: path of the file, writer, actions, server, and its clock."""
    path = tmp_path / "run.mcap"
    actions, clock = Actions(), [EPOCH_NS]
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        events = writer.log()
        handler = RequestHandler(
            actions, writer, lambda *event: events.write(clock[0], *event), lambda: clock[0]
        )
        server = ControlServer(tmp_path / "c.sock", handler)
        yield path, writer, actions, server, clock
        server.close()


def read(path, topic):
    """Log time and decoded message of each, by a foreign reader."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages([topic])
        return [(message.log_time, decoded) for _, _, message, decoded in found]


def test_a_controller_s_gait_is_in_the_session_as_it_was_said(session):
    path, writer, _, server, clock = session
    said = []
    with polled(server, pause_s=0), ControlClient(server.path) as client:
        for k in range(1000):
            clock[0] = EPOCH_NS + k * 10_000_000
            values = {"horizontal.phase": 0.1 * k, "horizontal.A": 0.4 + k / 7}
            t_ns = clock[0] - 3_000_001 if k % 2 else None
            request = {"do": "gait", "values": values}
            assert client.ask(request if t_ns is None else {**request, "t_ns": t_ns}) == {}
            said.append((clock[0], t_ns or clock[0], values))
    writer.close()
    found = read(path, "/gait")
    assert len(found) == 1000
    for (log_ns, t_ns, values), (found_ns, state) in zip(said, found, strict=True):
        assert dict(zip(state.name, state.position, strict=True)) == values
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == t_ns
        assert found_ns == log_ns
    assert list(found[0][1].name) == ["horizontal.A", "horizontal.phase"]


def test_values_of_joints_and_of_a_controller_come_behind_those_of_the_planes(session):
    path, writer, _, server, _ = session
    values = {"steer.offset": 0.1, "joint03.A": None, "horizontal.omega": 3.0, "horizontal.A": 0.4}
    with polled(server), ControlClient(server.path) as client:
        client.ask({"do": "gait", "values": values})
    writer.close()
    ((_, state),) = read(path, "/gait")
    assert list(state.name) == ["horizontal.A", "horizontal.omega", "steer.offset", "joint03.A"]
    assert list(state.position[:3]) == [0.4, 3.0, 0.1]
    assert math.isnan(state.position[3])  # null: it has none


def test_notes_marks_and_modes_are_in_the_session(session):
    path, writer, actions, server, clock = session
    with polled(server), ControlClient(server.path) as client:
        assert client.ask({"do": "status"}) == {"output": "run.mcap", "elapsed_s": 1.5}
        client.ask({"do": "note", "text": "wet sand"})
        assert client.ask({"do": "mark", "text": "slipped", "level": "warn"}) == {
            "file": "run_mark0001.mcap"
        }
        client.ask({"do": "mark"})
        client.ask({"do": "mode", "text": "walk"})
        clock[0] += 7
        client.ask({"do": "mode", "text": "avoid"})
        client.ask({"do": "stop"})
    writer.close()
    events = [(event.name, event.level, event.msg) for _, event in read(path, "/rosout")]
    assert events == [
        (OPERATOR, 20, "wet sand"),
        (OPERATOR, 30, "mark: slipped"),
        (OPERATOR, 20, "mark"),
    ]
    modes = [(log_ns, mode.data) for log_ns, mode in read(path, "/gait/mode")]
    assert modes == [(EPOCH_NS, "walk"), (EPOCH_NS + 7, "avoid")]
    assert actions.done == [("mark", "slipped"), ("mark", ""), ("stop",)]


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
def test_a_wrong_request_says_what_would_be_right(session, request_, why):
    path, writer, actions, server, _ = session
    with polled(server), ControlClient(server.path) as client:
        with pytest.raises(ControlError) as refused:
            client.ask(request_)
        assert why in str(refused.value)
        client.ask({"do": "status"})
    writer.close()
    assert actions.done == []
    assert [*read(path, "/rosout"), *read(path, "/gait"), *read(path, "/gait/mode")] == []


def test_an_infinite_number_is_no_gait(session):
    *_, server, _ = session
    with connected(server) as client:
        client.sendall(b'{"do": "gait", "values": {"horizontal.A": 1e999}}\n')
        (reply,) = drain(server, client, 1)
        assert "a finite number" in reply["error"]


def test_other_names_than_at_first_are_refused_and_the_first_go_on(session):
    path, writer, _, server, _ = session
    with polled(server), ControlClient(server.path) as client:
        client.ask({"do": "gait", "values": {"horizontal.A": 1.0}})
        with pytest.raises(ControlError, match="the names that this session's gait began with"):
            client.ask({"do": "gait", "values": {"horizontal.A": 1.0, "vertical.A": 2.0}})
        client.ask({"do": "gait", "values": {"horizontal.A": 3.0}})
    writer.close()
    assert [state.position[0] for _, state in read(path, "/gait")] == [1.0, 3.0]


def test_a_gait_that_a_source_writes_is_not_taken_from_outside(session):
    _, writer, _, server, _ = session
    writer.joint_state("/gait", ["horizontal.A"], unit="rad")
    with (
        polled(server),
        ControlClient(server.path) as client,
        pytest.raises(ControlError, match="/gait is open already"),
    ):
        client.ask({"do": "gait", "values": {"horizontal.A": 1.0}})
