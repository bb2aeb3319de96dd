"""Tables and arrays of other tools, each written by its format's own library."""

import csv
import json
import pickle
import zipfile

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from support.imported import open_tables
from support.paths import ARCSNAKE, SHARED
from undulog.capture import Session
from undulog.capture.common.errors import ImportFormatError
from undulog.capture.exchange.formats.torch_tensors import read_tensors
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS
from undulog.capture.exchange.table_import import import_tables

T = np.arange(300) * 0.01
Q = np.stack([np.sin(3 * T + k) for k in range(3)], axis=1)
V = np.gradient(Q, T, axis=0)
C = Q + 0.01
SO101, GO2 = SHARED / "so101", SHARED / "go2"


def imported(source, tmp_path, *, commands=None, **options):
    return import_tables(open_tables(source, commands), tmp_path / "run.mcap", **options)


def joints(tmp_path, topic="/joint_states", field="position"):
    with Session.open(tmp_path / "run.mcap") as session:
        series = session.joints(topic, field)
        return (
            series.names,
            np.array([series.signal(n).values for n in series.names]).T,
            [series.signal(n).t_ns - RELATIVE_EPOCH_NS for n in series.names],
        )


def frame():
    columns = {"time_s": T}
    for k in range(3):
        columns[f"joint{k + 1}_pos"] = Q[:, k]
        columns[f"joint{k + 1}_vel"] = V[:, k]
        columns[f"joint{k + 1}_cmd_pos"] = C[:, k]
    return pd.DataFrame(columns)


def assert_all(tmp_path, *, names=("joint1", "joint2", "joint3"), velocity=V):
    t_ns = np.rint(T * 1e9)
    for topic, field, values in (
        ("/joint_states", "position", Q),
        ("/joint_states", "velocity", velocity),
        ("/joint_commands", "position", C),
    ):
        if values is None:
            continue
        columns, got, stamps = joints(tmp_path, topic, field)
        assert columns == names
        np.testing.assert_array_equal(got, values)
        np.testing.assert_array_equal(stamps, [t_ns] * 3)


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
def test_a_wide_table_needs_no_map(delimiter, tmp_path):
    frame().to_csv(tmp_path / "log.csv", sep=delimiter, index=False)
    report = imported(tmp_path / "log.csv", tmp_path)
    assert_all(tmp_path)
    assert any(note.startswith("positions taken as rad: no unit given") for note in report.notes)


def test_commas_as_decimal_points(tmp_path):
    frame().to_csv(tmp_path / "log.csv", sep=";", decimal=",", index=False)
    imported(tmp_path / "log.csv", tmp_path)
    assert_all(tmp_path)


def test_a_long_table_becomes_a_wide_one(tmp_path):
    rows = [(t, f"j{k}", Q[i, k], C[i, k]) for i, t in enumerate(T.tolist()) for k in range(3)]
    with (tmp_path / "log.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([("time", "joint", "angle (rad)", "target (rad)"), *rows])
    imported(tmp_path / "log.csv", tmp_path)
    assert_all(tmp_path, names=("j0", "j1", "j2"), velocity=None)


def test_a_table_without_a_header_has_positions_behind_its_times(tmp_path):
    np.savetxt(tmp_path / "log.csv", np.column_stack([T, Q]), delimiter=",")
    imported(tmp_path / "log.csv", tmp_path)
    names, values, _ = joints(tmp_path)
    assert names == ("joint01", "joint02", "joint03")
    np.testing.assert_allclose(values, Q, rtol=1e-17, atol=1e-17)


def test_vectors_in_cells_of_two_files_with_own_clocks(tmp_path):
    late = T + 0.0037
    for name, t, values in (("commands", late, C), ("states", T, Q)):
        with (tmp_path / f"{name}.csv").open("w", newline="") as stream:
            rows = [(f"{x * 1e6:.3f}", v.tolist()) for x, v in zip(t, values, strict=True)]
            csv.writer(stream).writerows([("timestamp", "positions"), *rows])
    report = imported(tmp_path / "states.csv", tmp_path, commands=tmp_path / "commands.csv")
    assert any("taken as us" in note for note in report.notes)
    np.testing.assert_array_equal(joints(tmp_path)[1], Q)
    _, values, stamps = joints(tmp_path, "/joint_commands")
    np.testing.assert_array_equal(values, C)
    np.testing.assert_array_equal(stamps[0], np.rint(late * 1e9))


def test_a_map_is_written_edited_and_given_back(tmp_path, command):
    frame().to_csv(tmp_path / "log.csv", index=False)
    line = ["import", tmp_path / "log.csv", "-o", tmp_path / "run.mcap"]
    path = tmp_path / "map.toml"
    command(*line, "--write-map", path, "--unit", "position=deg")
    np.testing.assert_allclose(joints(tmp_path)[1], np.radians(Q))
    command(*line, "--write-map", path, "--force")
    edited = path.read_text().replace('joint = "joint1"', 'joint = "head"')
    path.write_text(edited.replace('unit = "rad"', 'unit = "mrad"'))
    command(*line, "--columns", path, "--force")
    names, values, _ = joints(tmp_path)
    assert names == ("head", "joint2", "joint3")
    np.testing.assert_allclose(values, Q * 1e-3)
    other = ["import", tmp_path / "log.csv", "-o", tmp_path / "new.mcap", "--write-map", path]
    assert "exists already" in command(*other, code=2).err
    assert not (tmp_path / "new.mcap").exists()


def test_a_wrapped_angle_is_unwrapped_over_blocks(tmp_path):
    t = np.arange(60_000) * 0.005
    angle = 9 * np.sin(0.5 * t)
    wrapped = (angle + 2 * np.pi) % (4 * np.pi) - 2 * np.pi
    pd.DataFrame({"time": t, "s_pos": wrapped}).to_csv(tmp_path / "log.csv", index=False)
    report = imported(tmp_path / "log.csv", tmp_path)
    assert any("taken as wrapping around" in note for note in report.notes)
    np.testing.assert_allclose(joints(tmp_path)[1][:, 0], angle, atol=1e-9)


def arrays():
    return {"time": T, "dof_pos": Q, "dof_vel": V, "des_dof_pos": C, "kp": np.ones(3)}


@pytest.mark.parametrize("kind", ["npz", "mat", "parquet"])
def test_arrays_by_their_own_libraries(kind, tmp_path):
    path = tmp_path / f"run.{kind}"
    if kind == "npz":
        np.savez_compressed(path, **arrays())
    elif kind == "mat":
        savemat(path, arrays(), do_compression=True)
    else:
        table = {n: v.tolist() for n, v in arrays().items() if len(v) == len(T)}
        pq.write_table(pa.table(table), path)
    report = imported(path, tmp_path)
    assert_all(tmp_path, names=("joint01", "joint02", "joint03"))
    assert kind == "parquet" or any("left out: kp" in note for note in report.notes)


def test_a_pickle_is_read_and_nothing_of_it_is_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (exec, (f"open({str(tmp_path / 'ran')!r}, 'w')",))

    with zipfile.ZipFile(tmp_path / "x.pt", "w") as archive:
        archive.writestr("x/data.pkl", pickle.dumps({"time": Evil(), "b": [1]}, protocol=2))
    assert set(read_tensors(tmp_path / "x.pt")) == {"time", "b"}
    with pytest.raises(ImportFormatError, match="holds no arrays"):
        imported(tmp_path / "x.pt", tmp_path)
    assert not (tmp_path / "ran").exists()


def test_a_mat_of_version_7_3_is_named(tmp_path):
    (tmp_path / "x.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(600, b" "))
    with pytest.raises(ImportFormatError, match=r"version 7\.3 \(HDF5\), which is not supported"):
        open_tables(tmp_path / "x.mat")


def test_a_huge_declared_shape_is_refused(tmp_path):
    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999,), }"
    head = b"\x93NUMPY\x01\x00v\x00" + shape
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("time.npy", head.ljust(127) + b"\n" + bytes(80))
    with pytest.raises(ImportFormatError, match="more than it holds"):
        open_tables(tmp_path / "x.npz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,a_pos\n0,1\n1,x\n", "has the columns|no column|not a number|named as"),
        ("time,a_pos\n0,1\n1,inf\n", "row 3, column 'a_pos': 'inf' is not a finite number"),
        ("time,a_pos\n1,1\n0.5,1\n", "time goes back"),
        ("time,b\n0,1\n1,2\n", "no column is named as a position"),
        ("x\n1\n", "is no table"),
        ("", "is no table"),
    ],
)
def test_faults_of_a_table(text, message, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(ImportFormatError, match=message):
        imported(tmp_path / "log.csv", tmp_path)
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.skipif(not SO101.exists(), reason=f"the SO-101 data are not at {SO101}")
def test_the_folder_of_an_arm(tmp_path):
    report = imported(SO101 / "multisine", tmp_path)
    assert report.samples == {"/joint_commands": 6000, "/joint_states": 6000, "/rosout": 3}
    raw = pd.read_csv(SO101 / "multisine" / "state_motor.csv")
    for field, column in (("position", "positions"), ("effort", "torques")):
        names, values, stamps = joints(tmp_path, "/joint_states", field)
        assert names == ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
        np.testing.assert_array_equal(values, [json.loads(cell) for cell in raw[column]])
        np.testing.assert_allclose(stamps[0], raw["timestamp"] * 1e3, atol=1)


@pytest.mark.skipif(not GO2.exists(), reason=f"the Go2 data are not at {GO2}")
def test_the_tensors_of_a_quadruped(tmp_path):
    imported(GO2 / "traj_0.pt", tmp_path)
    with zipfile.ZipFile(GO2 / "traj_0.pt") as archive:
        raw = np.frombuffer(archive.read("traj_0/data/1"), "<f4").reshape(-1, 12)
    np.testing.assert_array_equal(joints(tmp_path)[1], raw)


@pytest.mark.skipif(not ARCSNAKE.exists(), reason=f"the ArcSnake data are not at {ARCSNAKE}")
def test_the_joint_of_a_screw_snake_has_no_commands(tmp_path, command):
    imported(ARCSNAKE / "joint7_no_load.csv", tmp_path)
    raw = np.genfromtxt(ARCSNAKE / "joint7_no_load.csv", delimiter=",", names=True)
    turns = (joints(tmp_path)[1][:, 0] - raw["s_pos"]) / (4 * np.pi)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)
    assert "No command logged" in command("analyse", tmp_path / "run.mcap").out
