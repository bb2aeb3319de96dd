"""Reading in bulk: one pass for joints and tables, windows, own times, frames of any batch size."""

import numpy as np
import pytest
import zstandard

from support.read_back import chunks_of, decoded_of
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import DataError
from undulog.capture.log.columns.buffers import ColumnStore, EchoColumn, Times, TimeStore
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.log.read.sample_times import JointSeries, own_times

EPOCH_NS = 1_700_000_000_000_000_000
NAMES = [f"joint{k:02d}" for k in range(1, 6)]
STEP_NS = 10_000_000


def write_session(path, ticks, *, stall=None):
    """Joints polled in turn; from tick ``stall`` on, 300 ticks are logged late, all at once."""
    rng = np.random.default_rng(3)
    values, offsets = rng.normal(size=(ticks, 5)), rng.uniform(0, 8e-3, size=(ticks, 5))
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True)
        times = writer.joint_state("/joint_sample_offset", NAMES, unit="s")
        current = writer.joint_state("/joint_current", NAMES, unit="A")
        imu = writer.imu("/imu", frame="head")
        for tick in range(ticks):
            t_ns = EPOCH_NS + tick * STEP_NS
            late = stall is not None and stall <= tick < stall + 300
            log = {"log_time_ns": EPOCH_NS + (stall + 300) * STEP_NS if late else t_ns}
            states.write(t_ns, values[tick], -values[tick], **log)
            times.write(t_ns, offsets[tick], **log)
            current.write(t_ns, 2 * values[tick], **log)
            imu.write(t_ns, values[tick, :3], **log)
    t_ns = EPOCH_NS + np.arange(ticks)[:, None] * STEP_NS + np.rint(offsets * 1e9).astype(np.int64)
    return t_ns, values


def test_one_pass_gives_what_each_reader_gives(tmp_path):
    path = tmp_path / "s.mcap"
    t_ns, values = write_session(path, 5000)
    selection = {"/joint_states": ["position", "velocity"], "/joint_current": ["position"]}
    with Session(path) as session:
        signals, tables = session.columns(selection, {"/imu": ["linear_acceleration.z"]})
        table = session.table("/imu")
    keys = [(topic, field) for topic, fields in selection.items() for field in fields]
    for key, scale in zip(keys, (1, -1, 2), strict=True):
        series = signals[key]
        np.testing.assert_array_equal(np.array(series.values).T, scale * values)
        np.testing.assert_array_equal(np.array(series.t_ns).T, t_ns)
    assert list(tables["/imu"].columns) == ["linear_acceleration.z"]
    assert tables["/imu"].equals(table[["linear_acceleration.z"]])
    np.testing.assert_array_equal(tables["/imu"]["linear_acceleration.z"], values[:, 2])


def test_offsets_that_are_asked_for_are_not_overwritten(tmp_path):
    t_ns, _ = write_session(tmp_path / "s.mcap", 50)
    selection = {"/joint_states": ["position"], "/joint_sample_offset": ["position"]}
    with Session(tmp_path / "s.mcap") as session:
        columns = session.joint_columns(selection)
        with pytest.raises(DataError, match="not for both"):
            session.columns({"/joint_states": ["position"]}, {"/joint_sample_offset": None})
    stamps = EPOCH_NS + np.arange(50) * STEP_NS
    offsets = np.array(columns["/joint_sample_offset", "position"].values)
    np.testing.assert_allclose(offsets, (t_ns.T - stamps) * 1e-9, atol=1e-9)
    np.testing.assert_array_equal(np.array(columns["/joint_states", "position"].t_ns).T, t_ns)


@pytest.mark.parametrize("stall", [None, 1500])
def test_a_window_is_what_the_whole_has_of_it(tmp_path, stall):
    path = tmp_path / "s.mcap"
    t_ns, values = write_session(path, 4000, stall=stall)
    rng = np.random.default_rng(4)
    with Session(path) as session:
        for start in [0, 1450, 1550, 1790, *rng.integers(0, 3900, 20).tolist()]:
            start_ns = EPOCH_NS + start * STEP_NS + 3_000_000
            stop_ns = start_ns + int(rng.integers(1, 100)) * STEP_NS
            series = session.joints("/joint_states", start_ns=start_ns, stop_ns=stop_ns)
            for j in range(5):
                inside = (t_ns[:, j] >= start_ns) & (t_ns[:, j] < stop_ns)
                np.testing.assert_array_equal(series.t_ns[j], t_ns[inside, j])
                np.testing.assert_array_equal(series.values[j], values[inside, j])


def test_frames_come_in_the_order_they_were_logged(tmp_path):
    rng = np.random.default_rng(5)
    order, number = [], 0
    with SessionWriter(tmp_path / "s.mcap", session_id="s", epoch_ns=EPOCH_NS) as writer:
        channel = writer.frames("/can/can0")
        for tick in range(200):
            frames = empty_frames(int(rng.integers(0, 5)))
            frames["id_flags"] = number + np.arange(len(frames))
            number += len(frames)
            late = EPOCH_NS + (tick if tick % 7 else max(tick - 9, 0)) * STEP_NS
            order.append((late, tick, frames["id_flags"].tolist()))
            channel.write(late, frames)
    with Session(tmp_path / "s.mcap") as session:
        numbers = session.frames("/can/can0")["id_flags"].tolist()
    assert numbers == [number for _, _, batch in sorted(order) for number in batch]


def test_own_times_of_series_that_are_stamped_differently():
    stamps = np.array([100, 200, 300, 400])
    offsets = JointSeries(("a",), [stamps], [np.array([1e-9, 2e-9, np.nan, 4e-9])])
    series = JointSeries(("a", "b"), [np.array([50, 250, 350])] * 2, [np.zeros(3)] * 2)
    (own_ns,) = own_times([series], offsets)
    assert own_ns[0].tolist() == [51, 252, 350]
    assert own_ns[1].tolist() == [50, 250, 350]


def test_stores_grow_and_keep_far_log_times():
    store = ColumnStore("<f8", 3, 1)
    rows = np.random.default_rng(6).normal(size=(1000, 3))
    for part in np.array_split(rows, 37):
        store.append(part)
    np.testing.assert_array_equal(store.values(), rows)
    times = TimeStore(1, stamped=True)
    stamps = EPOCH_NS + np.arange(5)
    for behind in (10, 2**31, -(2**40)):
        times.append(Times.of(stamps + behind, stamps))
    assert (times.log() - times.stamps()).tolist() == [10] * 5 + [2**31] * 5 + [-(2**40)] * 5


@pytest.mark.parametrize("seed", range(20))
def test_echoes_keep_their_own_rows_whatever_the_others_get(seed):
    rng = np.random.default_rng(seed)
    columns, truth = [], [[] for _ in range(4)]
    for _ in truth:
        columns.append(EchoColumn("<i8", 3, tuple(columns)))
    for _ in range(30):
        rows = rng.integers(0, 9, rng.integers(0, 5))
        for column, kept in zip(columns, truth, strict=True):
            mine = rows if rng.random() < 0.97 else rng.integers(0, 9, rng.integers(0, 5))
            column.append(mine)
            kept.extend(mine.tolist())
    assert [column.column().tolist() for column in columns] == truth
    assert [len(column) for column in columns] == [len(kept) for kept in truth]


def test_a_damaged_frame_is_found_by_its_own_checksum(tmp_path):
    path = tmp_path / "s.mcap"
    write_session(path, 20)
    (chunk,) = chunks_of(path, "/imu")
    data = bytearray(path.read_bytes())
    at = data.index(b"\x28\xb5\x2f\xfd", chunk.chunk_start_offset)
    assert zstandard.get_frame_parameters(bytes(data[at : at + 64])).has_checksum
    size = int.from_bytes(data[at - 8 : at], "little")
    data[at + size - 1] ^= 1  # the checksum itself: all else is whole
    path.write_bytes(data)
    with Session(path) as session:
        assert len(session.table("/imu")) == 0
        assert any("can't be decompressed" in text for text in session.warnings)


@pytest.mark.parametrize("seed", range(5))
def test_sensors_of_shared_and_own_stamps_are_what_a_foreign_reader_finds(tmp_path, seed):
    rng = np.random.default_rng(seed)
    path = tmp_path / "s.mcap"
    topics = [f"/ir/{k:02d}" for k in range(1, 5)]
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        options = {"infrared": True, "min_range": 0.0, "max_range": 4.0, "field_of_view": 0.1}
        channels = [writer.range(topic, frame=topic[1:], **options) for topic in topics]
        field = writer.magnetic_field("/compass", frame="compass")
        for tick in range(400):
            t_ns = EPOCH_NS + tick * STEP_NS
            for k, channel in enumerate(channels):
                chance = rng.random() if tick > 100 * k else 1.0
                if chance > 0.02:  # one in fifty is missing, one has a stamp of its own
                    stamp = t_ns + k if chance < 0.04 else t_ns
                    channel.write(stamp, rng.random(), log_time_ns=t_ns + 5 * (chance < 0.06))
            if tick % 2:
                field.write(t_ns, rng.normal(size=3))
    with Session(path) as session:
        _, tables = session.columns({}, {topic: ["range"] for topic in topics})
    for topic in topics:
        theirs = [content for *_, content in decoded_of(path, [topic])]
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in theirs]
        order = np.argsort(stamps, kind="stable")
        assert tables[topic].index.tolist() == np.array(stamps)[order].tolist()
        assert tables[topic]["range"].tolist() == [theirs[k].range for k in order]
