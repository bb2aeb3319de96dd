"""Joint columns for pandas: read by pandas and pyarrow, held against the session's own reader."""

import json
import sys

import numpy as np
import pandas as pd
import pytest

from support.imported import TABLE_SUFFIXES, import_can, open_mapped
from support.imported import export_file as export_columns
from support.paths import TRACE as RECORDING
from support.written_sessions import joint_state, write_foreign
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import DataError, MissingChannelError, MissingExtraError
from undulog.capture.exchange.column_map import column_map_from_options
from undulog.capture.exchange.table_import import import_tables

S = 1_000_000_000
T0 = 1_700_000_000 * S
NAMES = ("joint01", "joint02", "joint03")
READ = {".csv": pd.read_csv, ".parquet": pd.read_parquet}
COLUMNS = [f"joint_states.{name}" for name in ("position [rad]", "velocity [rad/s]")]
COLUMNS.append("joint_current [A]")


@pytest.fixture(scope="module")
def polled(tmp_path_factory):
    """Three joints asked in turn, 2 ms apart, every 10 ms; one misses some rounds."""
    path = tmp_path_factory.mktemp("polled") / "run.mcap"
    rng = np.random.default_rng(2)
    with SessionWriter(path, session_id="s", epoch_ns=T0) as writer:
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True)
        offsets = writer.joint_state("/joint_sample_offset", NAMES, unit="s")
        current = writer.joint_state("/joint_current", NAMES, unit="A")
        gait = writer.joint_state("/gait", ["horizontal.A"], unit="")
        for k in range(200):
            t_ns = T0 + k * 10_000_000
            position = rng.normal(size=3)
            if k % 50 == 7:
                position[1] = np.nan
            offsets.write(t_ns, [0.0, 0.002, 0.004 + 1e-9 * k])
            states.write(t_ns, position, rng.normal(size=3) * 1e-12)
            current.write(t_ns, rng.normal(size=3))
            gait.write(t_ns, [0.4])
    return path


def assert_same_samples(table, session, topic, field, column):
    signals = session.joints(topic, field)
    rows = table[table["topic"] == topic]
    assert len(rows) == sum(map(len, signals.t_ns))
    assert (np.diff(rows["t_ns"]) >= 0).all()
    for name, t_ns, values in zip(signals.names, signals.t_ns, signals.values, strict=True):
        of_joint = rows[rows["joint"] == name]
        np.testing.assert_array_equal(of_joint["t_ns"], t_ns)
        np.testing.assert_array_equal(of_joint[column], values)  # bit for bit, NaN where NaN
    assert table[column][table["topic"] != topic].isna().all()


@pytest.mark.parametrize("rows_per_block", [100_000, 10])
@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
def test_each_sample_has_a_row_at_its_own_time(
    suffix, rows_per_block, polled, tmp_path, monkeypatch
):
    monkeypatch.setattr("undulog.capture.exchange.long_table._ROWS_PER_BLOCK", rows_per_block)
    output = tmp_path / f"x{suffix}"
    report = export_columns(polled, output)
    assert report.facts["topics"] == {"/joint_states": 600, "/joint_current": 600}
    assert report.warnings == []
    table = READ[suffix](output)
    assert list(table.columns) == ["t_ns", "topic", "joint", *COLUMNS]
    assert table["t_ns"].dtype == np.int64
    with Session.open(polled) as session:
        topics = ("/joint_states", "/joint_states", "/joint_current")
        fields = ("position", "velocity", "position")
        for topic, field, column in zip(topics, fields, COLUMNS, strict=True):
            assert_same_samples(table, session, topic, field, column)
    first = table[table["topic"] == "/joint_states"].head(3)
    assert first["joint"].tolist() == list(NAMES)
    assert (first["t_ns"] - T0).tolist() == [0, 2_000_000, 4_000_000]


def test_topics_can_be_chosen(polled, tmp_path):
    report = export_columns(polled, tmp_path / "x.csv", topics=["/gait", "/joint_current", "/gait"])
    assert report.facts["topics"] == {"/gait": 200, "/joint_current": 600}
    table = pd.read_csv(tmp_path / "x.csv")
    assert set(table["joint"][table["topic"] == "/gait"]) == {"horizontal.A"}
    with pytest.raises(MissingChannelError, match="has no /no; it has /gait, /joint_current"):
        export_columns(polled, tmp_path / "y.csv", topics=["/no"])
    with SessionWriter(tmp_path / "t.mcap", session_id="s", epoch_ns=T0) as writer:
        writer.string("/gait/mode").write(T0, "walk")
    with pytest.raises(DataError, match="/gait/mode is std_msgs/msg/String, not of joints"):
        export_columns(tmp_path / "t.mcap", tmp_path / "y.csv", topics=["/gait/mode"])
    with pytest.raises(MissingChannelError, match="has no joint topics; it has /gait/mode"):
        export_columns(tmp_path / "t.mcap", tmp_path / "y.csv")
    assert not (tmp_path / "y.csv").exists()


@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
def test_a_foreign_log_with_fields_that_come_and_go(suffix, tmp_path):
    # One message a servo, some without velocity: the fields don't share times.
    messages = []
    for k in range(40):
        velocity = [k * 0.2] if k % 4 < 2 else []
        content = joint_state(T0 + k * 1_000_000, [f"servo{k % 2}"], [k * 0.1], velocity=velocity)
        messages.append(("/servo/states", T0 + k * 1_000_000, content))
    write_foreign(tmp_path / "run.mcap", messages)
    report = export_columns(tmp_path / "run.mcap", tmp_path / f"x{suffix}")
    assert report.facts["topics"] == {"/servo/states": 60}
    table = READ[suffix](tmp_path / f"x{suffix}")
    position = table.dropna(subset=["servo/states.position [rad]"])
    assert position["servo/states.position [rad]"].tolist() == [k * 0.1 for k in range(40)]
    assert (position["t_ns"] - T0).tolist() == [k * 1_000_000 for k in range(40)]
    velocity = table.dropna(subset=["servo/states.velocity [rad/s]"])
    assert velocity["joint"].tolist() == ["servo0", "servo1"] * 10
    expected = [k * 0.2 for k in range(40) if k % 4 < 2]
    assert velocity["servo/states.velocity [rad/s]"].tolist() == expected


def test_parquet_keeps_nan_as_null_and_text_as_categories(polled, tmp_path):
    import pyarrow.parquet as pq

    export_columns(polled, tmp_path / "x.parquet")
    table = pq.read_table(tmp_path / "x.parquet")
    categories = "dictionary<values=string, indices=int32, ordered=0>"
    kinds = [str(kind) for kind in table.schema.types[:4]]
    assert kinds == ["int64", categories, categories, "double"]
    assert table["joint_states.position [rad]"].null_count == 600 + 4


def test_a_csv_of_one_joint_can_be_imported_again(tmp_path, opened):
    if not RECORDING.exists():
        pytest.skip(f"the ArcSnake recording is not at {RECORDING}")
    robot = load_robot("arcsnake-joint")
    import_can(RECORDING, tmp_path / "run.mcap", robot)
    report = export_columns(tmp_path / "run.mcap", tmp_path / "all.csv")
    table = pd.read_csv(tmp_path / "all.csv")
    with Session.open(tmp_path / "run.mcap") as session:
        assert report.facts["rows"] == len(table)
        for topic, column in zip(report.facts["topics"], list(table.columns)[3:], strict=True):
            assert_same_samples(table, session, topic, "position", column)
        states = session.joints("/joint_states").signal("joint01")
    export_columns(tmp_path / "run.mcap", tmp_path / "x.csv", topics=["/joint_states"])
    options = ["t_ns=time:ns", "joint_states.position [rad]=joint01.position:rad"]
    columns = column_map_from_options(options, robot)
    tables = open_mapped(tmp_path / "x.csv", columns)
    import_tables(tables, tmp_path / "back.mcap", robot=robot, column_map=columns)
    back = opened(tmp_path / "back.mcap").joints("/joint_states").signal("joint01")
    np.testing.assert_array_equal(back.t_ns, states.t_ns)
    np.testing.assert_array_equal(back.values, states.values)


def test_the_verb(polled, tmp_path, command):
    output = tmp_path / "x.csv"
    export = ("log", "export", polled, "-o", output)
    report = f"{output}: 1200 rows of /joint_states, /joint_current\n"
    assert command(*export) == (report, "")
    assert "x.csv exists already" in command(*export, code=2).err
    report = json.loads(command(*export, "--force", "--json", "--topics", "/gait").out)
    assert (report["rows"], report["topics"], report["warnings"]) == (200, {"/gait": 200}, [])
    refused = command(*export, "--force", "--bus", "can0", code=2).err
    assert "--bus is for CAN frames; a .csv file has joint columns" in refused


def test_a_missing_package_is_named(polled, tmp_path, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError):
        export_columns(polled, tmp_path / "x.parquet")
    refused = command("log", "export", polled, "-o", tmp_path / "x.parquet", code=2).err
    assert "a .parquet table needs the package pyarrow" in refused
    assert list(tmp_path.iterdir()) == []
