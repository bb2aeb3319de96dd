"""What undulog writes, read by the packages of other tools: each number comes out as it went in."""

import json

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from pyarrow import csv
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from support.imported import export_file as export_columns
from support.imported import export_wide
from support.read_back import decoded_of, messages_of
from support.written_sessions import EPOCH_NS, NAMES, STEP_NS, write_session
from undulog.capture.exchange.formats.lerobot.exporting import export_lerobot
from undulog.capture.exchange.formats.lerobot.importing import import_lerobot
from undulog.capture.exchange.formats.rosbag.exporting import export_rosbag2

COUNT = 300
T_NS = EPOCH_NS + STEP_NS * np.arange(COUNT)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A session and its exports; positions, velocities and efforts, (n, 3, m)."""
    folder = tmp_path_factory.mktemp("exported")
    data = write_session(folder / "run.mcap", count=COUNT)
    export_rosbag2(folder / "run.mcap", folder / "bag")
    export_lerobot([folder / "run.mcap"], folder / "set", fps=100)
    for suffix in (".csv", ".parquet"):
        export_columns(folder / "run.mcap", folder / f"long{suffix}")
        export_wide(folder / "run.mcap", folder / f"wide{suffix}")
    return folder, data


def states_by_mcap(path):
    """Times and positions by mcap and mcap-ros2-support."""
    messages_of(path)  # checks each CRC
    rows = [(t, message.position) for _, t, message in decoded_of(path, ["/joint_states"])]
    return np.array([t for t, _ in rows]), np.array([values for _, values in rows])


def states_by_rosbags(path):
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        ways = [
            connection for connection in reader.connections if connection.topic == "/joint_states"
        ]
        rows = [
            (t, reader.deserialize(data, way.msgtype).position)
            for way, t, data in reader.messages(ways)
        ]
    return np.array([t for t, _ in rows]), np.array([values for _, values in rows])


@pytest.mark.parametrize(
    ("read", "name"),
    [
        *((states_by_mcap, name) for name in ("run.mcap", "bag/bag_0.mcap")),
        *((states_by_rosbags, name) for name in ("run.mcap", "bag/bag_0.mcap", "bag")),
    ],
)
def test_messages_of_a_session_and_of_its_bag(read, name, exported):
    folder, data = exported
    t_ns, positions = read(folder / name)
    np.testing.assert_array_equal(t_ns, T_NS)
    np.testing.assert_array_equal(positions, data[:, 0])


@pytest.mark.parametrize("read", [states_by_mcap, states_by_rosbags])
def test_messages_of_an_imported_dataset(read, tmp_path):
    """Enough frames for several chunks, which have a compression of their own."""
    count, joints = 9000, 12
    values = np.random.default_rng(5).normal(size=(count, joints)).astype(np.float32)
    values[0, :4] = [-0.0, 1e-45, 3e38, np.float32(0.1)]
    (tmp_path / "set/data/chunk-000").mkdir(parents=True)
    (tmp_path / "set/meta").mkdir()
    feature = {"dtype": "float32", "shape": [joints], "names": None}
    info = {"codebase_version": "v3.0", "fps": 50, "features": {"observation.state": feature}}
    (tmp_path / "set/meta/info.json").write_text(json.dumps(info))
    columns = {
        "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), joints),
        "frame_index": np.arange(count),
        "episode_index": np.zeros(count, dtype=np.int64),
    }
    pq.write_table(pa.table(columns), tmp_path / "set/data/chunk-000/file-000.parquet")
    import_lerobot(tmp_path / "set", tmp_path / "run.mcap")
    t_ns, positions = read(tmp_path / "run.mcap")
    np.testing.assert_array_equal(t_ns - t_ns[0], np.arange(count) * 20_000_000)
    assert positions.tobytes() == values.astype(float).tobytes()  # -0.0 among them


def by_pandas(path):
    return pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)


def by_pyarrow(path):
    table = csv.read_csv(path) if path.suffix == ".csv" else pq.read_table(path)
    return table.to_pandas()


def by_duckdb(path):
    source = f"read_csv('{path}', sample_size=-1)" if path.suffix == ".csv" else f"'{path}'"
    return duckdb.sql(f"select * from {source}").df()


@pytest.mark.parametrize("read", [by_pandas, by_pyarrow, by_duckdb])
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_tables(read, suffix, exported):
    folder, data = exported
    wide, long = (read(folder / f"{kind}{suffix}") for kind in ("wide", "long"))
    np.testing.assert_array_equal(wide["t_ns"], T_NS)
    for k, name in enumerate(NAMES):
        np.testing.assert_array_equal(wide[f"{name}.position [rad]"], data[:, 0, k])
        np.testing.assert_array_equal(wide[f"{name}.velocity [rad/s]"], data[:, 1, k])
        of_joint = long[(long["topic"] == "/joint_states") & (long["joint"] == name)]
        np.testing.assert_array_equal(of_joint["t_ns"], T_NS)
        np.testing.assert_array_equal(of_joint["joint_states.effort [N m]"], data[:, 2, k])
    assert {str(long[name].dtype) for name in long.columns[3:]} == {"float64"}


def test_a_dataset(exported):
    folder, data = exported
    table = ds.dataset(folder / "set/data", format="parquet").to_table()
    states = np.array(table["observation.state"].to_pylist(), dtype=np.float32)
    np.testing.assert_array_equal(states, data[:, 0].astype(np.float32))
    frames = duckdb.sql(f"select * from '{folder}/set/data/*/*.parquet' order by index").df()
    np.testing.assert_array_equal(np.stack(frames["action"]), data[:, 0].astype(np.float32))
    assert list(pd.read_parquet(folder / "set/meta/tasks.parquet").columns) == ["task_index"]
