"""Views of a session, against the session itself."""

import numpy as np
import pytest

from support.written_sessions import write_session
from undulog.capture import Session, SessionView
from undulog.capture.common.errors import MissingChannelError
from undulog.capture.log.read.field_arrays import FieldArrays, joined

START_S, STOP_S = 1.0, 2.5
POSE_X = "pose.pose.position.x"


@pytest.fixture
def session(tmp_path):
    write_session(tmp_path / "a.mcap")
    with Session.open(tmp_path / "a.mcap") as opened:
        yield opened


@pytest.fixture
def limits(session):
    limits = {"start_ns": START_S, "stop_ns": STOP_S}
    return {name: session.start_ns + round(at_s * 1e9) for name, at_s in limits.items()}


def same_signals(first, second):
    assert first.names == second.names
    np.testing.assert_array_equal(first.t_ns, second.t_ns)
    np.testing.assert_array_equal(first.values, second.values)


def test_a_window_holds_what_lies_in_it_and_no_more(session, limits):
    view = session.view(**limits)
    whole = session.joints("/joint_states")
    part = view.joints("/joint_states")
    inside = slice(*np.searchsorted(whole.t_ns[0], list(limits.values())))
    assert 0 < inside.start < inside.stop < whole.t_ns[0].size
    np.testing.assert_array_equal(part.t_ns[0], whole.t_ns[0][inside])
    np.testing.assert_array_equal(part.values[1], whole.values[1][inside])
    assert (view.start_ns, view.end_ns) == tuple(limits.values())
    assert view.duration_s == STOP_S - START_S
    assert session.start_ns < view.start_ns < view.end_ns < session.end_ns


def test_tables_and_messages_of_a_window_are_chosen_by_log_time(session, limits):
    view = session.view(**limits)
    log_ns = [t_ns for t_ns, _ in session.messages("/odom")]
    inside = [t_ns for t_ns in log_ns if limits["start_ns"] <= t_ns < limits["stop_ns"]]
    assert 0 < len(inside) < len(log_ns)
    assert [t_ns for t_ns, _ in view.messages("/odom")] == inside
    assert len(view.table("/odom")) == len(inside)
    signals, tables = view.columns({"/joint_states": ["position"]}, {"/odom": [POSE_X]})
    assert len(tables["/odom"]) == len(inside)
    same_signals(signals["/joint_states", "position"], view.joints("/joint_states"))


def test_a_view_of_a_view_and_a_read_of_a_view_narrow_it(session, limits):
    view = session.view(stop_ns=limits["stop_ns"])
    expected = session.joints("/joint_states", **limits)
    same_signals(view.joints("/joint_states", start_ns=limits["start_ns"]), expected)
    twice = view.view(start_ns=limits["start_ns"], stop_ns=session.end_ns)
    same_signals(twice.joints("/joint_states"), expected)


def test_renamed_topics_are_read_by_their_new_names(session):
    view = session.view(rename={"/joint_commands": "/joint_states", "/pose": "/odom"})
    assert {"/joint_commands", "/pose"} <= view.channels.keys()
    assert not {"/joint_states", "/odom"} & view.channels.keys()
    assert view.channels["/pose"].topic == "/pose"
    assert view.channels["/pose"].count == session.channels["/odom"].count
    same_signals(view.joints("/joint_commands"), session.joints("/joint_states"))
    assert view.table("/pose").equals(session.table("/odom"))
    assert len(list(view.messages("/pose"))) == session.channels["/odom"].count
    signals, tables = view.columns({"/joint_commands": ["position"]}, {"/pose": [POSE_X]})
    same_signals(signals["/joint_commands", "position"], session.joints("/joint_states"))
    assert tables["/pose"].columns.tolist() == [POSE_X]
    assert view.view(stop_ns=session.start_ns + 10**9).channels == view.channels
    with pytest.raises(MissingChannelError):
        session.view(rename={"/joint_commands": "/none"})


def test_two_names_of_one_topic_are_both_read(session):
    view = session.view(rename=dict.fromkeys(("/first", "/second"), "/joint_states"))
    columns = view.joint_columns({"/first": ["position"], "/second": ["velocity", "position"]})
    assert list(columns) == [
        ("/first", "position"),
        ("/second", "velocity"),
        ("/second", "position"),
    ]
    same_signals(columns["/first", "position"], columns["/second", "position"])


def test_a_view_reads_through_the_open_file_and_shares_its_warnings(session):
    view = session.view(stop_ns=session.end_ns)
    assert isinstance(session, SessionView)
    assert not hasattr(view, "close")
    assert view.robot is session.robot
    assert view.warnings == session.warnings
    assert view.session_id == session.session_id


def test_arrays_hold_what_the_table_holds(session, limits):
    view = session.view(**limits, rename={"/pose": "/odom"})
    for read, topic in ((session, "/odom"), (view, "/pose")):
        arrays, table = read.arrays({topic: None})[topic], read.table(topic)
        assert arrays.t_ns.tolist() == table.index.tolist()
        assert list(arrays.values) == table.columns.tolist()
        for path, values in arrays.values.items():
            assert values.tolist() == table[path].tolist()
    with pytest.raises(MissingChannelError):
        session.arrays({"/none": None})


def test_arrays_of_several_layouts_are_in_order_of_time():
    first = FieldArrays(np.array([10, 30]), {"x": np.array([1.0, 3.0]), "n": np.array([7, 8])})
    second = FieldArrays(np.array([20, 30]), {"x": np.array([2.0, 4.0])})
    both = joined([first, second])
    assert both.t_ns.tolist() == [10, 20, 30, 30]
    assert both.values["x"].tolist() == [1.0, 2.0, 3.0, 4.0]
    np.testing.assert_array_equal(both.values["n"], [7, np.nan, 8, np.nan])
    assert joined([]).t_ns.size == 0
