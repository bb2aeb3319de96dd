"""Logs of other makes as sessions: any number of joints a message, any clock, any container."""

import hostile_logs
import numpy as np
import pytest
from mcap.records import Schema
from mcap.writer import CompressionType, IndexType
from mcap_ros2.decoder import DecoderFactory

from support.foreign_logs import foreign_log
from support.written_sessions import (
    EPOCH_NS,
    JOINT_STATE,
    NAMES,
    STEP_NS,
    joint_state,
    samples,
    write_foreign,
)
from undulog.capture import Session
from undulog.capture.common.errors import MissingChannelError
from undulog.capture.log.messages.definitions import schema_text


def states(t_ns, names, position, *, log_ns=0, **more):
    return "/joint_states", log_ns or t_ns, joint_state(t_ns, names, position, **more)


def test_one_message_per_servo_is_read_right(tmp_path):
    data = samples(200)
    messages = [
        states(EPOCH_NS + tick * STEP_NS + j * 1_000_000, [name], [float(data[tick, 0, j])])
        for tick in range(200)
        for j, name in enumerate(NAMES)
    ]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        signals = session.joints("/joint_states")
        assert signals.names == NAMES
        for j in range(3):
            np.testing.assert_array_equal(signals.values[j], data[:, 0, j])
            expected = EPOCH_NS + np.arange(200) * STEP_NS + j * 1_000_000
            np.testing.assert_array_equal(signals.t_ns[j], expected)
        assert session.warnings == []


def test_a_changed_joint_set_is_reported_and_read(tmp_path):
    messages = [
        states(EPOCH_NS + tick * STEP_NS, ["a", "b" if tick < 50 else "c"], [float(tick), 1.0])
        for tick in range(100)
    ]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        signals = session.joints("/joint_states")
        assert [len(t) for t in signals.t_ns] == [100, 50, 50]
        np.testing.assert_array_equal(signals.values[0], np.arange(100.0))
        assert any("set of joints changes" in w and "b, c" in w for w in session.warnings)


def test_a_later_window_is_not_read_with_the_names_of_an_earlier_one(tmp_path):
    step_ns = 100_000_000
    messages = [  # of one length
        states(EPOCH_NS + tick * step_ns, list("ab" if tick < 300 else "bc"), [tick, -tick])
        for tick in range(600)
    ]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        for first in (100, 450, 100, 295, 450, 295):
            start_ns = EPOCH_NS + first * step_ns
            window = {"start_ns": start_ns, "stop_ns": start_ns + 10 * step_ns}
            series = session.joints("/joint_states", **window)
            inside = range(first, first + 10)
            truth = {
                "a": [tick for tick in inside if tick < 300],
                "b": [-tick if tick < 300 else tick for tick in inside],
                "c": [-tick for tick in inside if tick >= 300],
            }
            read = dict(zip(series.names, (v.tolist() for v in series.values), strict=True))
            assert read == {name: truth[name] for name in truth if truth[name] or name in read}


def test_duplicate_and_backward_stamps_are_reported(tmp_path):
    messages = [
        states(EPOCH_NS + tick * STEP_NS, ["a"], [float(tick)], log_ns=EPOCH_NS + k * STEP_NS)
        for k, tick in enumerate([0, 1, 2, 2, 4, 3, 5])
    ]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        assert session.joints("/joint_states").values[0].tolist() == [0, 1, 2, 2, 3, 4, 5]
        text = " ".join(session.warnings)
    assert "1 samples go back in time" in text
    assert "1 samples repeat the stamp" in text


def test_a_field_that_is_never_filled_is_missing_not_zero(tmp_path):
    path = write_foreign(tmp_path / "f.mcap", [states(EPOCH_NS, ["a"], [1.0], velocity=[])])
    missing = "has no effort in /joint_states; it has position"
    with Session.open(path) as session, pytest.raises(MissingChannelError, match=missing):
        session.joints("/joint_states", "effort")


def test_values_that_do_not_match_the_names_are_left_out_with_a_warning(tmp_path):
    messages = [states(EPOCH_NS + k, ["a", "b"], row) for k, row in enumerate(([1.0], [1.0, 2.0]))]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        assert session.joints("/joint_states").values[1].tolist() == [2.0]
        assert "2 names but 1 values of position" in session.warnings[0]


def test_nan_samples_are_kept(tmp_path, opened):
    messages = [states(EPOCH_NS, ["a"], [float("nan")])]
    session = opened(write_foreign(tmp_path / "f.mcap", messages))
    assert np.isnan(session.joints("/joint_states").values[0]).all()


def test_zero_stamps_fall_back_to_log_times(tmp_path):
    messages = [states(0, ["a"], [float(k)], log_ns=EPOCH_NS + k) for k in range(3)]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        assert session.joints("/joint_states").t_ns[0].tolist() == [EPOCH_NS + k for k in range(3)]
        assert "header stamps are zero" in session.warnings[0]


def test_simulated_time_is_shifted_to_the_log_clock(tmp_path):
    steps = [(k, k * STEP_NS) for k in range(50)]
    messages = [
        (topic, EPOCH_NS + t_ns, joint_state(5_000_000_000 + t_ns, ["a"], [float(k)]))
        for k, t_ns in steps
        for topic in ("/joint_states", "/joint_commands")
    ]
    with Session.open(write_foreign(tmp_path / "f.mcap", messages)) as session:
        states = session.joints("/joint_states", start_ns=EPOCH_NS, stop_ns=EPOCH_NS + 10**9)
        commands = session.joints("/joint_commands")
        assert len(states.t_ns[0]) == 50
        np.testing.assert_array_equal(states.t_ns[0], commands.t_ns[0])
        np.testing.assert_array_equal(session.table("/joint_states").index, commands.t_ns[0])
        assert "another clock" in session.warnings[0]


@pytest.mark.parametrize(
    ("options", "warned"),
    [
        ({"compression": CompressionType.LZ4}, False),
        ({"compression": CompressionType.NONE}, False),
        ({"use_chunking": False}, True),
        ({"index_types": IndexType.NONE}, True),
        ({"index_types": IndexType.CHUNK}, False),
        ({"repeat_channels": False}, True),
        ({"use_statistics": False}, True),
    ],
)
def test_any_kind_of_mcap_reads_the_same(tmp_path, options, warned):
    data = samples(500)
    path = tmp_path / "f.mcap"
    with foreign_log(path, JOINT_STATE, chunk_size=20_000, **options) as (writer, schema):
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for tick, row in enumerate(data):
            t_ns = EPOCH_NS + tick * STEP_NS
            message = hostile_logs.joint_state(t_ns, NAMES, row[0])
            writer.add_message(channel, t_ns, message, t_ns)
    with Session.open(tmp_path / "f.mcap") as session:
        signals = session.joints("/joint_states")
        np.testing.assert_array_equal(np.array(signals.values).T, data[:, 0])
        assert session.channels["/joint_states"].count == 500
        assert bool(session.warnings) == warned


def test_undefined_padding_of_a_foreign_writer_does_no_harm(tmp_path, opened):
    plain = hostile_logs.joint_state(EPOCH_NS, ["ab"], [1.5])
    padding_at = 4 + 8 + 4 + 1  # header, stamp, length of frame_id, its terminating zero
    assert plain[padding_at : padding_at + 3] == bytes(3)
    with foreign_log(tmp_path / "f.mcap", JOINT_STATE) as (writer, schema):
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(20):
            message = bytearray(plain)
            message[padding_at] = k
            writer.add_message(channel, EPOCH_NS + k, bytes(message), EPOCH_NS + k)
    record = Schema(1, schema_text(JOINT_STATE).encode(), "ros2msg", JOINT_STATE)
    assert list(DecoderFactory().decoder_for("cdr", record)(bytes(message)).position) == [1.5]
    assert opened(tmp_path / "f.mcap").joints("/joint_states").values[0].tolist() == [1.5] * 20
