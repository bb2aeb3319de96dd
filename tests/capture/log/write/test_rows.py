"""Many samples at once against one by one: mcap's readers find the same messages."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from support.read_back import decoded_of, messages_of
from undulog.capture import SessionWriter
from undulog.capture.common.errors import DataError
from undulog.capture.log.wal.reader import recover
from undulog.capture.log.wal.writer import WriteAheadLog
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.log.write.writer import open_sensor
from undulog.capture.robot.model import Sensor, SensorKind

EPOCH_NS = 1_700_000_000_000_000_000
_SCALAR = (SensorKind.IR, SensorKind.SONAR)
FACTS = {"session_id": "s", "epoch_ns": EPOCH_NS}


def session(path, names, times, fields, *, at_once, sink=None):
    """Write one joint topic; return its messages: log time, publish time, sequence, bytes."""
    _, velocity, effort = fields
    options = {"velocity": velocity.shape[1] > 0, "effort": effort.shape[1] > 0}
    with SessionWriter(path, **FACTS, sink=sink, force=True) as writer:
        channel = writer.joint_state("/joint_states", names, unit="rad", **options)
        if at_once:
            for part in np.array_split(np.arange(len(times)), 3):
                channel.write_rows(times[part], *(field[part] for field in fields))
        else:
            for row in zip(times.tolist(), *fields, strict=True):
                channel.write(*row)
    messages = [message for *_, message in messages_of(path, log_time_order=False)]
    return [(m.log_time, m.publish_time, m.sequence, m.data) for m in messages]


@st.composite
def samples(draw):
    names = draw(st.lists(st.text(max_size=9), min_size=1, max_size=6, unique=True))
    rows = draw(st.integers(0, 20))
    times = draw(arrays.arrays(np.int64, rows, elements=st.integers(0, 2**31 * 10**9 - 1)))
    width = st.sampled_from([0, len(names)])
    columns = len(names), draw(width), draw(width)
    return names, times, [draw(arrays.arrays(np.float64, (rows, m))) for m in columns]


@settings(max_examples=60, deadline=None)
@given(case=samples())
def test_the_same_messages(case, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rows")
    single, many = (session(folder / f"{k}.mcap", *case, at_once=k) for k in (False, True))
    assert many == single
    assert len(single) == len(case[1])


@pytest.fixture(scope="module")
def long_run():
    """Some chunks of messages; the values are told apart, and one of a thousand is none."""
    names = [f"joint{k:02d}" for k in range(25)]
    times = EPOCH_NS + np.arange(9000) * 10_000_000
    fields = [np.arange(9000 * 25).reshape(9000, 25) * scale for scale in (1e-3, 1.0, -1.0)]
    fields[0].ravel()[::1000] = np.nan
    return names, times, fields


def test_over_several_chunks(tmp_path, long_run):
    single, many = (session(tmp_path / f"{k}.mcap", *long_run, at_once=k) for k in (False, True))
    assert many == single
    assert (tmp_path / "True.mcap").read_bytes() == (tmp_path / "False.mcap").read_bytes()


def test_a_foreign_decoder_reads_the_values(tmp_path, long_run):
    names, times, fields = long_run
    session(tmp_path / "x.mcap", *long_run, at_once=True)
    messages = [(t_ns, message) for _, t_ns, message in decoded_of(tmp_path / "x.mcap")]
    assert [t_ns for t_ns, _ in messages] == times.tolist()
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in messages]
    assert stamps == times.tolist()
    for name, field in zip(("position", "velocity", "effort"), fields, strict=True):
        assert np.array_equal([getattr(m, name) for _, m in messages], field, equal_nan=True)
    assert messages[-1][1].name == names


@pytest.mark.parametrize("segment_size", [1 << 14, 1 << 20])
def test_through_the_write_ahead_log(tmp_path, long_run, segment_size):
    names, times, fields = long_run
    some = names, times[:200], [field[:200] for field in fields]
    path = tmp_path / "run.mcap"
    sink = DurableSink(path, segment_size=segment_size, ballast=0)
    through = session(path, *some, at_once=True, sink=sink)
    assert through == session(tmp_path / "one.mcap", *some, at_once=False)


def test_parts_of_a_split_session(tmp_path, long_run):
    names, times, fields = long_run
    some = names, times[:400], [field[:400] for field in fields]
    runs = []
    for at_once in (False, True):
        path = tmp_path / str(at_once) / "run.mcap"
        path.parent.mkdir()
        sink = DurableSink(path, split_ns=10**9, ballast=0)  # some boundaries are within a batch
        session(path, *some, at_once=at_once, sink=sink)
        parts = sorted(path.parent.glob("*.mcap"))
        runs.append([[m.data for *_, m in messages_of(part)] for part in parts])
    assert runs[0] == runs[1]
    assert len(runs[0]) == 4


@settings(max_examples=60, deadline=None)
@given(
    sizes=st.lists(st.tuples(st.integers(0, 3000), st.integers(1, 30)), max_size=20),
    segment_size=st.sampled_from([1 << 12, 1 << 14, 1 << 16]),
)
def test_the_write_ahead_log_is_that_of_single_messages(sizes, segment_size, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wal")
    logs = []
    for at_once in (False, True):
        with WriteAheadLog(folder / str(at_once), segment_size=segment_size) as wal:
            for k, (size, count) in enumerate(sizes):
                messages = [(k, 7 * n, 9 * n, n, bytes([n]) * size) for n in range(count)]
                if not (at_once and wal.append_all(messages)):
                    for message in messages:
                        wal.append(*message)
        recovery = recover(folder / str(at_once))
        logs.append([message[:] for message in recovery])
        assert (recovery.missing, recovery.before) == (0, 0)
    assert logs[0] == logs[1]
    assert len(logs[0]) == sum(count for _, count in sizes)


@pytest.mark.parametrize("kind", list(SensorKind))
def test_sensors_many_at_once_as_one_by_one(tmp_path, kind):
    values = np.random.default_rng(1).normal(size=(20, 1 if kind in _SCALAR else 3))
    values[3] = np.nan
    times, logged = EPOCH_NS + np.arange(20) * 7, EPOCH_NS + np.arange(20) * 7 + 5
    sensor = Sensor("one", kind, "head", (0.0, 0.0, 0.0), range_min=0.1, range_max=4.0)
    files = []
    for at_once in (False, True):
        path = tmp_path / f"{at_once}.mcap"
        with SessionWriter(path, **FACTS) as writer:
            channel = open_sensor(writer, sensor)
            if at_once:
                channel.write_rows(times, values, logged)
            else:
                for t_ns, row, log_ns in zip(times.tolist(), values, logged.tolist(), strict=True):
                    channel.write(t_ns, row, log_time_ns=log_ns)
        files.append([(m.log_time, m.publish_time, m.data) for *_, m in messages_of(path)])
    assert files[0] == files[1]
    assert len(files[0]) == 20


def test_a_wrong_shape_is_refused(tmp_path):
    with SessionWriter(tmp_path / "x.mcap", **FACTS) as writer:
        channel = writer.joint_state("/joint_states", ["a", "b"], unit="rad")
        none = np.empty((3, 0))
        with pytest.raises(ValueError, match="position has the shape"):
            channel.write_rows(np.arange(3), np.zeros((3, 3)), none, none)
        with pytest.raises(ValueError, match="velocity has the shape"):
            channel.write_rows(np.arange(3), np.zeros((3, 2)), np.zeros((3, 2)), none)


@pytest.mark.parametrize("t_ns", [-1, 2**31 * 10**9])
def test_a_time_that_no_stamp_holds_is_refused(tmp_path, t_ns):
    with SessionWriter(tmp_path / "x.mcap", **FACTS) as writer:
        channel = writer.joint_state("/joint_states", ["a"], unit="rad")
        none = np.empty((2, 0))
        with pytest.raises(DataError, match="32 bits"):
            channel.write_rows(np.array([5, t_ns]), np.zeros((2, 1)), none, none)
