"""LeRobot datasets: read by pyarrow and pandas, held against pandas' merge_asof, imported again."""

import json

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from support.paths import SHARED
from support.written_sessions import write_commands
from support.written_topics import write_topics
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.exchange.formats.lerobot.exporting import export_lerobot
from undulog.capture.exchange.formats.lerobot.importing import import_lerobot

G1 = SHARED / "g1_lerobot_v21"
T0 = 1_700_000_000 * 10**9
NAMES = ("shoulder_pan", "elbow", "wrist-2")
FEATURES = {"action": "/joint_commands", "observation.state": "/joint_states"}


def write_arm(path, seed=0, names=NAMES, rounds=400):
    """Joints asked in turn at an uneven rate, with a NaN, and commands that begin later."""
    rng = np.random.default_rng(seed)
    with SessionWriter(path, session_id=f"s{seed}", epoch_ns=T0) as writer:
        commands = writer.joint_state("/joint_commands", names, unit="rad")
        states = writer.joint_state("/joint_states", names, unit="rad", velocity=True)
        offsets = writer.joint_state("/joint_sample_offset", names, unit="s")
        offsets.write(T0, 0.003 * np.arange(len(names)))
        t_ns = T0
        for k in range(rounds):
            t_ns += int(rng.integers(5_000_000, 15_000_000))
            position = rng.normal(size=len(names))
            if k % 50 == 9:
                position[0] = np.nan
            states.write(t_ns, position, position)
            if k > 20:
                commands.write(t_ns - 1_000_000, rng.normal(size=len(names)))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of three sessions, and the sessions."""
    folder = tmp_path_factory.mktemp("made")
    runs = [write_arm(folder / f"run{k}.mcap", seed=k, rounds=300 + 50 * k) for k in range(3)]
    return runs, folder / "set", export_lerobot(runs, folder / "set", fps=30, task="wave")


def frames_of(folder):
    return pd.concat(map(pd.read_parquet, sorted((folder / "data").glob("*/*.parquet"))))


def test_each_frame_holds_the_last_sample_and_its_time(made):
    runs, folder, report = made
    frames = frames_of(folder)
    episodes = pd.read_parquet(folder / "meta/episodes/chunk-000/file-000.parquet")
    assert report.facts["episodes"] == episodes["length"].tolist()
    for number, path in enumerate(runs):
        of_episode = frames[frames["episode_index"] == number]
        assert of_episode["frame_index"].tolist() == list(range(len(of_episode)))
        frame_ns = np.rint(np.arange(len(of_episode)) * 1e9 / 30).astype(np.int64)
        frame_ns += int(episodes["undulog/start_ns"][number])
        with Session.open(path) as session:
            starts = []
            for feature, topic in FEATURES.items():
                values, times = (
                    np.stack(of_episode[feature]),
                    np.stack(of_episode[f"sample_time.{feature}"]),
                )
                assert (values.dtype, times.dtype) == (np.float32, np.int64)
                for j, name in enumerate(NAMES):
                    signal = session.joints(topic).signal(name)
                    table = pd.DataFrame({"t": signal.t_ns, "x": signal.values, "s": signal.t_ns})
                    table = table.dropna()
                    starts.append(table["t"].iloc[0])
                    held = pd.merge_asof(pd.DataFrame({"t": frame_ns}), table, on="t")
                    np.testing.assert_array_equal(values[:, j], held["x"].astype(np.float32))
                    np.testing.assert_array_equal(times[:, j], held["s"])
            assert frame_ns[0] == max(starts)


def test_the_description_fits_the_files(made):
    _, folder, _ = made
    info = json.loads((folder / "meta/info.json").read_text())
    frames, count = frames_of(folder), sum(made[2].facts["episodes"])
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (3, count, 30)
    assert info["splits"] == {"train": "0:3"}
    schema = pq.read_schema(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert schema.names == list(info["features"])
    for name, feature in info["features"].items():
        kind = {"float32": "float", "int64": "int64"}[feature["dtype"]]
        size = feature["shape"][0]
        expected = kind if size == 1 else f"fixed_size_list<element: {kind}>[{size}]"
        assert str(schema.field(name).type) == expected
    assert frames["index"].tolist() == list(range(count))
    np.testing.assert_array_equal(frames["timestamp"], np.float32(frames["frame_index"] / 30))
    tasks = pd.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.loc["wave", "task_index"] == 0
    episodes = pd.read_parquet(folder / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["dataset_to_index"].tolist() == np.cumsum(made[2].facts["episodes"]).tolist()
    assert episodes["dataset_from_index"].iloc[0] == 0
    assert episodes["tasks"].map(list).tolist() == [["wave"]] * 3


def test_statistics_are_those_of_the_frames(made):
    _, folder, _ = made
    frames = frames_of(folder)
    stats = json.loads((folder / "meta/stats.json").read_text())
    episodes = pd.read_parquet(folder / "meta/episodes/chunk-000/file-000.parquet")
    for name in ("action", "observation.state", "frame_index"):
        values = np.stack(frames[name]).astype(float).reshape(len(frames), -1)
        for key in ("min", "max", "mean", "std"):
            expected = getattr(np, key)(values, axis=0)
            np.testing.assert_allclose(stats[name][key], expected, rtol=1e-9)
        assert stats[name]["count"] == [len(frames)]
        of_episode = values[(frames["episode_index"] == 1).to_numpy()]
        np.testing.assert_allclose(episodes[f"stats/{name}/mean"][1], of_episode.mean(axis=0))
        np.testing.assert_allclose(
            episodes[f"stats/{name}/q10"][1], np.quantile(of_episode, 0.1, axis=0)
        )


def test_an_import_reads_the_frames_back(made, tmp_path):
    _, folder, _ = made
    frames = frames_of(folder)
    for number, report in enumerate(import_lerobot(folder, tmp_path / "back")):
        of_episode = frames[frames["episode_index"] == number]
        with Session.open(report.output) as session:
            assert session.metadata["undulog"]["import.task"] == "wave"
            for feature, topic in FEATURES.items():
                series = session.joints(topic)
                assert series.names == NAMES
                got = np.stack([series.signal(name).values for name in NAMES], axis=1)
                np.testing.assert_array_equal(got, np.stack(of_episode[feature]))  # bit for bit


@pytest.mark.skipif(not G1.exists(), reason=f"the G1 data are not at {G1}")
def test_a_real_dataset_comes_back(tmp_path):
    import_lerobot(G1, tmp_path / "g1")
    runs = sorted((tmp_path / "g1").iterdir())
    report = export_lerobot(runs, tmp_path / "set", fps=30)
    frames = frames_of(tmp_path / "set")
    for number, path in enumerate(sorted((G1 / "data" / "chunk-000").iterdir())):
        original = pd.read_parquet(path)
        of_episode = frames[frames["episode_index"] == number]
        assert len(of_episode) == len(original) == report.facts["episodes"][number]
        for name in (*FEATURES, "frame_index", "timestamp"):
            np.testing.assert_array_equal(np.stack(of_episode[name]), np.stack(original[name]))


def test_one_joint_is_a_plain_number(tmp_path, opened):
    write_arm(tmp_path / "run.mcap", names=("only",))
    export_lerobot([tmp_path / "run.mcap"], tmp_path / "set", fps=20)
    frames = frames_of(tmp_path / "set")
    assert frames["action"].dtype == np.float32
    (report,) = import_lerobot(tmp_path / "set", tmp_path / "back")
    got = opened(report.output).joints("/joint_states").signal("only").values
    np.testing.assert_array_equal(got, frames["observation.state"])


def test_what_is_lost_is_reported(tmp_path):
    path = write_commands(tmp_path / "run.mcap", ["a"], [[float(k)] for k in range(101)])
    report = export_lerobot([path], tmp_path / "set", fps=50)  # commands come 100 times a second
    assert report.facts["episodes"] == [51]
    assert report.warnings[0] == "no /joint_states: no observation.state"
    assert report.warnings[-1].startswith(
        "action at 50 frames a second: 50 of 101 samples left out, values up to 0 s old (a)"
    )
    assert frames_of(tmp_path / "set")["action"].tolist() == list(range(0, 101, 2))


def test_what_is_no_dataset_is_refused(tmp_path, command):
    runs = [write_arm(tmp_path / "a.mcap", seed=1)]
    runs.append(write_arm(tmp_path / "b.mcap", seed=2, names=("other", *NAMES[1:])))
    with pytest.raises(DataError, match=r"joints of action aren't those .* \(other, shoulder_pan"):
        export_lerobot(runs, tmp_path / "set", fps=30)
    with pytest.raises(UsageError, match="frames a second, 1 to"):
        export_lerobot(runs[:1], tmp_path / "set", fps=0)
    topics = {"/joint_states": (["a", "b"], "rad", [[1.0, np.nan]])}
    write_topics(tmp_path / "c.mcap", [T0], topics, epoch_ns=T0)
    with pytest.raises(DataError, match="no samples of b"):
        export_lerobot([tmp_path / "c.mcap"], tmp_path / "set", fps=30)
    times = [T0, T0 + 10**18 // 4]  # a clock that jumped by eight years
    write_topics(tmp_path / "d.mcap", times, {"/joint_states": (["a"], "rad", [1.0, 1.0])})
    with pytest.raises(DataError, match=r"would have 7500000001 frames .* cut it first"):
        export_lerobot([tmp_path / "d.mcap"], tmp_path / "set", fps=30)
    assert not list(tmp_path.glob("set*"))
    line = ("log", "export", runs[0], "--to", "lerobot", "-o", tmp_path / "set")
    assert "--to lerobot needs --fps" in command(*line, code=2).err


def test_only_a_dataset_is_replaced(tmp_path, command, report_of):
    run = write_arm(tmp_path / "run.mcap")
    line = ("log", "export", run, "--to", "lerobot", "--fps", 30, "-o", tmp_path / "set")
    assert len(report_of(*line)["episodes"]) == 1
    assert "exists already" in command(*line, code=2).err
    command(*line, "--force")
    assert "name a folder to be made" in command(*line[:-1], ".", code=2).err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    other = (*line[:-1], tmp_path / "mine", "--force")
    assert "has files but no meta/info.json: it is not replaced" in command(*other, code=2).err
    assert (tmp_path / "mine" / "thesis.tex").exists()
    assert not list(tmp_path.glob("*.part"))
