"""Wide tables: read by pandas and pyarrow, held against the session, and imported again."""

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from support.imported import TABLE_SUFFIXES, export_wide, open_tables
from support.paths import SHARED
from support.written_sessions import joint_state, write_foreign, write_session
from support.written_topics import write_topics
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import DataError, MissingChannelError, UsageError
from undulog.capture.exchange.table_import import import_tables
from undulog.capture.exchange.wide_table import WideColumn, wide_blocks

T0 = 1_700_000_000 * 10**9
NAMES = ("joint01", "leftKnee", "neck_pos-2")
READ = {".csv": pd.read_csv, ".parquet": pd.read_parquet}
TOPICS = {
    "/joint_commands": ("position",),
    "/joint_states": ("position", "velocity", "effort"),
    "/joint_velocity": ("position",),
    "/joint_current": ("position",),
    "/joint_temperature": ("position",),
}


@pytest.fixture(scope="module")
def staggered(tmp_path_factory):
    """Joints asked in turn, with a joint that misses rounds, odd names and extreme numbers."""
    path = tmp_path_factory.mktemp("staggered") / "run.mcap"
    rng = np.random.default_rng(5)
    with SessionWriter(path, session_id="s", epoch_ns=T0) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True, effort=True)
        offsets = writer.joint_state("/joint_sample_offset", NAMES, unit="s")
        warm = writer.joint_state("/joint_temperature", NAMES[:2], unit="degC")
        offsets.write(T0, [0.0, 0.002, 0.004])
        for k in range(300):
            t_ns = T0 + k * 10_000_001
            extreme = rng.normal(size=3) * 10.0 ** rng.integers(-300, 99, 3)
            commands.write(t_ns, [-0.0, 7 * (-1.0) ** k, 0.1])
            states.write(t_ns, extreme, rng.normal(size=3), rng.normal(size=3))
            if k % 10 == 3:
                warm.write(t_ns + 7, rng.normal(size=2))
    return path


def assert_same_samples(back, session):
    compared = 0
    for topic, fields in TOPICS.items():
        for name in fields if topic in session.channels else ():
            try:
                expected = session.joints(topic, name)
            except MissingChannelError:
                continue
            got = back.joints(topic, name)
            assert (set(got.names), got.unit) == (set(expected.names), expected.unit)
            for joint in expected.names:
                original, other = expected.signal(joint), got.signal(joint)
                finite = ~np.isnan(original.values)
                np.testing.assert_array_equal(other.t_ns, original.t_ns[finite])
                assert other.values.tobytes() == original.values[finite].tobytes()  # also -0.0
                compared += len(original.t_ns)
    assert compared


@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
def test_an_import_of_the_table_gives_the_session(suffix, staggered, tmp_path, command, opened):
    table = tmp_path / f"run{suffix}"
    command("log", "export", staggered, "--to", "wide", "-o", table)
    command("import", table, "-o", tmp_path / "back.mcap")
    assert_same_samples(opened(tmp_path / "back.mcap"), opened(staggered))


RECORDINGS = ("so101/multisine", "so101/coupled_joints", "go2/traj_0.pt")


@pytest.mark.nightly
@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
@pytest.mark.parametrize("name", RECORDINGS)
def test_real_recordings_come_back(name, suffix, tmp_path, opened):
    source, table = SHARED / name, tmp_path / f"x{suffix}"
    if not source.exists():
        pytest.skip(f"the recording is not at {source}")
    import_tables(open_tables(source), tmp_path / "run.mcap")
    export_wide(tmp_path / "run.mcap", table)
    import_tables(open_tables(table), tmp_path / "back.mcap")
    assert_same_samples(opened(tmp_path / "back.mcap"), opened(tmp_path / "run.mcap"))


@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
def test_a_column_holds_the_samples_of_a_joint_at_their_times(suffix, staggered, tmp_path, opened):
    report = export_wide(staggered, tmp_path / f"x{suffix}")
    table = READ[suffix](tmp_path / f"x{suffix}")
    assert list(table.columns) == report.facts["columns"]
    assert len(table) == report.facts["rows"] == 300 * 3 + 30 * 2
    assert table["t_ns"].dtype == np.int64
    assert table["t_ns"].is_monotonic_increasing
    np.testing.assert_array_equal(table["time [s]"], (table["t_ns"] - T0) / 1e9)
    column = table[["t_ns", "leftKnee.effort [N m]"]].dropna()
    expected = opened(staggered).joints("/joint_states", "effort").signal("leftKnee")
    np.testing.assert_array_equal(column["t_ns"], expected.t_ns)
    np.testing.assert_array_equal(column["leftKnee.effort [N m]"], expected.values)
    (warning,) = report.warnings
    assert "% of the cells are empty: joints were sampled at times of their own" in warning


def test_no_sample_and_a_sample_without_a_number_differ(tmp_path):
    with SessionWriter(tmp_path / "run.mcap", session_id="s", epoch_ns=T0) as writer:
        states = writer.joint_state("/joint_states", ["a"], unit="rad")
        current = writer.joint_state("/joint_current", ["a"], unit="A")
        states.write(T0, [np.nan])
        states.write(T0 + 1, [2.0])
        current.write(T0, [3.0])
    for suffix in TABLE_SUFFIXES:
        export_wide(tmp_path / "run.mcap", tmp_path / f"x{suffix}")
    text = (tmp_path / "x.csv").read_text().splitlines()
    assert text[1:] == [f"{T0},0.0,nan,3.0", f"{T0 + 1},1e-09,2.0,"]
    table = pq.read_table(tmp_path / "x.parquet")
    assert [table[k].null_count for k in range(4)] == [0, 0, 0, 1]
    assert np.isnan(table["a.position [rad]"][0].as_py())


@st.composite
def columns(draw):
    clocks = [
        np.sort(np.array(draw(st.lists(st.integers(0, 12), max_size=25)), dtype=np.int64))
        for _ in range(draw(st.integers(1, 4)))
    ]
    return [
        WideColumn(f"c{k}", t_ns, draw(arrays(float, len(t_ns))))
        for k, t_ns in enumerate(draw(st.lists(st.sampled_from(clocks), min_size=1, max_size=6)))
    ]


@given(columns(), st.integers(1, 200))
def test_blocks_hold_each_sample_once_in_its_place(columns, cells):
    got = {column.name: ([], []) for column in columns}
    last, done = -1, 0.0
    for block in wide_blocks(columns, cells):
        assert block.t_ns[0] >= last
        assert (np.diff(block.t_ns) >= 0).all()
        assert block.done > done
        last, done = block.t_ns[-1], block.done
        for name, (rows, values) in block.cells.items():
            assert len(np.unique(rows)) == len(rows)
            got[name][0].extend(block.t_ns[rows])
            got[name][1].extend(values)
        assert set().union(*(rows for rows, _ in block.cells.values())) == set(
            range(len(block.t_ns))
        )
    for column in columns:
        np.testing.assert_array_equal(got[column.name][0], column.t_ns)
        np.testing.assert_array_equal(got[column.name][1], column.values)


def test_repeated_times_keep_their_order(tmp_path):
    times = [T0, T0, T0, T0 + 5]
    messages = [
        ("/joint_states", T0 + k, joint_state(t, ["a", "b"], [float(k), -float(k)]))
        for k, t in enumerate(times)
    ]
    write_foreign(tmp_path / "run.mcap", messages)
    report = export_wide(tmp_path / "run.mcap", tmp_path / "x.csv")
    table = pd.read_csv(tmp_path / "x.csv")
    assert table["a.position [rad]"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert table["t_ns"].tolist() == times
    assert "2 samples repeat the stamp before them" in report.warnings[-1]


def test_names_that_an_import_would_change_are_reported(tmp_path):
    messages = [("/arm/states", T0 + k, joint_state(T0 + k, ["=a", "b.c"], [k, k])) for k in (0, 1)]
    write_foreign(tmp_path / "run.mcap", messages)
    report = export_wide(tmp_path / "run.mcap", tmp_path / "x.csv", topics=["/arm/states"])
    assert "undulog import doesn't know these columns" in report.warnings[0]
    head = (tmp_path / "x.csv").read_text().splitlines()[0]
    expected = "t_ns,time [s],'=a.arm/states.position [rad],b.c.arm/states.position [rad]"
    assert head == expected  # a spreadsheet runs no formula


def test_what_is_no_wide_table_is_refused(tmp_path, command):
    write_session(tmp_path / "run.mcap")
    line = ("log", "export", tmp_path / "run.mcap", "--to", "wide", "-o")
    assert "no wide table has the suffix '.blf'" in command(*line, tmp_path / "x.blf", code=2).err
    assert (
        "--bus is for CAN frames; --to wide has joint columns"
        in command(*line, tmp_path / "x.csv", "--bus", "can0", code=2).err
    )
    command(*line, tmp_path / "x.csv")
    assert "exists already" in command(*line, tmp_path / "x.csv", code=2).err
    topics = {"/joint_states": ([f"j{k}" for k in range(2001)], "rad", np.zeros((1, 2001)))}
    write_topics(tmp_path / "wide.mcap", [T0], topics, epoch_ns=T0)
    with pytest.raises(UsageError, match="has 2001 joint columns; a wide table takes at most 2000"):
        export_wide(tmp_path / "wide.mcap", tmp_path / "y.csv")
    write_topics(tmp_path / "none.mcap", [], {"/joint_states": (["a"], "rad", [])}, epoch_ns=T0)
    with pytest.raises(DataError, match="carry no values"):
        export_wide(tmp_path / "none.mcap", tmp_path / "y.csv")
    assert not (tmp_path / "y.csv").exists()
    assert not list(tmp_path.glob("*.part"))


def test_a_large_table_that_is_nearly_empty_is_refused(tmp_path, monkeypatch):
    names, offsets = [f"j{k}" for k in range(250)], np.tile(1e-6 * np.arange(250), (4, 1))
    topics = {"/joint_states": (names, "rad", np.zeros((4, 250)))}
    topics["/joint_sample_offset"] = (names, "s", offsets)
    write_topics(tmp_path / "run.mcap", T0 + np.arange(4) * 10_000_000, topics, epoch_ns=T0)
    assert export_wide(tmp_path / "run.mcap", tmp_path / "x.csv").facts["rows"] == 1000
    monkeypatch.setattr("undulog.capture.exchange.wide_table._MOST_SPARSE", 10_000)
    with pytest.raises(UsageError, match=r"empty but for 0\.4% of its cells; choose columns"):
        export_wide(tmp_path / "run.mcap", tmp_path / "y.csv")
    assert not list(tmp_path.glob("y.csv*"))


def test_a_table_with_many_sets_of_joints_is_imported_whole(tmp_path):
    rng = np.random.default_rng(3)
    cells = rng.normal(size=(600, 12))
    cells[rng.random(cells.shape) < 0.5] = np.nan
    names = [f"j{k}.position [rad]" for k in range(12)]
    table = pd.DataFrame(cells, columns=names)
    table.insert(0, "t_ns", T0 + np.arange(600) * 10_000_000)
    table.to_csv(tmp_path / "x.csv", index=False)
    import_tables(open_tables(tmp_path / "x.csv"), tmp_path / "x.mcap")
    with Session.open(tmp_path / "x.mcap") as session:
        for k in range(12):
            got = session.joints("/joint_states").signal(f"j{k}")
            finite = ~np.isnan(got.values)
            np.testing.assert_array_equal(got.values[finite], cells[~np.isnan(cells[:, k]), k])
