"""LeRobot datasets: v3 and v2.1 written by pyarrow by their layout, and a real one."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from support.paths import SHARED
from undulog.capture import Session
from undulog.capture.common.errors import ImportFormatError
from undulog.capture.exchange.formats.lerobot.importing import import_lerobot
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS

G1 = SHARED / "g1_lerobot_v21"
JOINTS = ["shoulder_pan.pos", "elbow_flex.pos"]
LENGTHS = (50, 30, 40)
FPS = 30


def values(episode):
    t = np.arange(LENGTHS[episode]) / FPS
    return np.stack([np.sin(t + episode), np.cos(t)], axis=1).astype(np.float32)


def rows(episode):
    n = LENGTHS[episode]
    vectors = pa.FixedSizeListArray.from_arrays(pa.array(values(episode).ravel()), 2)
    return pa.table(
        {
            "action": vectors,
            "observation.state": vectors,
            "timestamp": pa.array((np.arange(n) / FPS).astype(np.float32)),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, episode),
            "task_index": np.zeros(n, dtype=np.int64),
        }
    )


def dataset(folder, version):
    """Write three episodes: v2.1 one a file, v3 two in the first file and one in the second."""
    feature = {"dtype": "float32", "shape": [2], "names": JOINTS}
    info = {"codebase_version": version, "fps": FPS, "robot_type": "so101_follower"}
    video = {"dtype": "video", "shape": [480, 640, 3], "names": None}
    info["features"] = {
        "action": feature,
        "observation.state": feature,
        "observation.images": video,
    }
    data = folder / "data" / "chunk-000"
    for path in (data, folder / "meta"):
        path.mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    if version == "v3.0":
        pq.write_table(pa.concat_tables([rows(0), rows(1)]), data / "file-000.parquet")
        pq.write_table(rows(2), data / "file-001.parquet")
        tasks = {"task_index": [0], "__index_level_0__": ["pick"]}
        pq.write_table(pa.table(tasks), folder / "meta" / "tasks.parquet")
    else:
        for k in range(3):
            pq.write_table(rows(k), data / f"episode_{k:06d}.parquet")
        (folder / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "pick"}\n')
    return folder


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_each_episode_is_a_session(version, tmp_path):
    reports = import_lerobot(dataset(tmp_path / "set", version), tmp_path / "out")
    assert [report.output.name for report in reports] == [f"episode_{k:06d}.mcap" for k in range(3)]
    ids = set()
    for k, report in enumerate(reports):
        with Session.open(report.output) as session:
            facts = session.metadata["undulog"]
            ids.add(session.session_id)
            for topic in ("/joint_commands", "/joint_states"):
                series = session.joints(topic)
                assert series.names == ("shoulder_pan", "elbow_flex")
                pan = series.signal("shoulder_pan")
                np.testing.assert_array_equal(pan.values, values(k)[:, 0])
                made = np.rint(np.arange(LENGTHS[k]) * 1e9 / FPS)
                np.testing.assert_array_equal(pan.t_ns - RELATIVE_EPOCH_NS, made)
        assert facts["import.times_from_fps"] == "30"
        assert facts["import.task"] == "pick"
    assert len(ids) == 3


def test_one_episode_into_one_file(tmp_path, command, opened):
    folder = dataset(tmp_path / "set", "v3.0")
    line = ["import", folder, "-o", tmp_path / "x.mcap"]
    assert "give a folder as -o, or --episode N" in command(*line, code=2).err
    command(*line, "--episode", 1, "--unit", "position=deg")
    states = opened(tmp_path / "x.mcap").joints("/joint_states").signal("shoulder_pan").values
    np.testing.assert_allclose(states, np.radians(values(1)[:, 0].astype(float)))
    assert "times made from fps = 30" in command("log", "check", tmp_path / "x.mcap").out
    with pytest.raises(ImportFormatError, match="has no episode 7; it has 0, 1, 2"):
        import_lerobot(folder, tmp_path / "y.mcap", episode=7)


def test_numbers_of_episodes_without_their_bytes_are_refused(tmp_path, command):
    """A million numbers take 35 kB, and each would become a session."""
    folder, count = dataset(tmp_path / "set", "v3.0"), 1_000_000
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    zeros = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(2 * count, np.float32)), 2)
    columns = {"action": zeros, "observation.state": zeros, "frame_index": np.zeros(count, int)}
    numbers = pa.table({**columns, "episode_index": np.arange(count)})
    options = {"use_dictionary": False, "column_encoding": {"episode_index": "DELTA_BINARY_PACKED"}}
    pq.write_table(numbers, path, compression="zstd", **options)
    assert path.stat().st_size < 100_000
    shown = command("import", folder, "-o", tmp_path / "out", code=1).err
    assert "more than its bytes can hold" in shown
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"features": {"action": 1}, "fps": 30}'])
def test_a_damaged_description_is_named(text, tmp_path):
    folder = dataset(tmp_path / "set", "v2.1")
    (folder / "meta" / "info.json").write_text(text)
    with pytest.raises(ImportFormatError, match=r"info\.json"):
        import_lerobot(folder, tmp_path / "out")


@pytest.mark.slow
@pytest.mark.skipif(not G1.exists(), reason=f"the G1 data are not at {G1}")
def test_a_humanoid(tmp_path, command):
    (report,) = import_lerobot(G1, tmp_path / "g1.mcap", episode=2)
    raw = pq.read_table(G1 / "data" / "chunk-000" / "episode_000002.parquet")
    with Session.open(report.output) as session:
        series = session.joints("/joint_commands")
        assert (len(series.names), series.names[0]) == (26, "kLeftShoulderPitch")
        got = np.array([series.signal(name).values for name in series.names]).T
    np.testing.assert_array_equal(got, np.array(raw["action"].to_pylist(), dtype=np.float32))
    answer = command("analyse", report.output).out
    assert "times made from fps = 30" in answer
