"""Tracks of markers become the joint angles that the markers were placed by."""

import json

import numpy as np
import pandas as pd
import pytest

from undulog.capture import Session

FPS, OMEGA, LAG = 120.0, 2 * np.pi * 1.7, 0.8
MARKERS = ("nose", "neck", "mid1", "mid2", "mid3", "tail")


def swimmer(seconds=6.0):
    """Joint angles (4, n), and points (6, 2, n) of segments of several lengths that turn and go."""
    t = np.arange(int(seconds * FPS)) / FPS
    angles = 0.3 * np.cos(OMEGA * t - LAG * np.arange(4)[:, None])
    heading = 0.2 * np.sin(0.3 * t) + np.concatenate((np.zeros((1, t.size)), np.cumsum(angles, 0)))
    length = np.array([30.0, 25.0, 20.0, 22.0, 15.0])[:, None]
    steps = np.stack((length * np.cos(heading), length * np.sin(heading)), axis=1)
    start = np.stack((300.0 - 40.0 * t, 200.0 + 5.0 * t))[None]
    return angles, np.concatenate((start, start + np.cumsum(steps, 0)))


def joints_of(path):
    with Session.open(path) as session:
        signals = session.joints("/joint_states")
        return signals.names, signals.t_ns, signals.values, session.metadata["undulog"]


def test_a_file_of_deeplabcut_opens_with_its_rate(tmp_path, command):
    angles, points = swimmer()
    columns, cells = [], []
    for name, (x, y) in zip(MARKERS, points, strict=True):
        for axis, values in (("x", x), ("y", y), ("likelihood", np.ones_like(x))):
            columns.append(("DLC_resnet50", name, axis))
            cells.append(values.copy())
    cells[2 * 3 + 2][100:110] = 0.3  # mid1 is hidden
    names = ["scorer", "bodyparts", "coords"]
    table = pd.DataFrame(np.array(cells).T, columns=pd.MultiIndex.from_tuples(columns, names=names))
    table.to_csv(tmp_path / "eel.csv")
    command("import", tmp_path / "eel.csv", "--fps", FPS, "-o", tmp_path / "eel.mcap")
    names, t_ns, values, facts = joints_of(tmp_path / "eel.mcap")
    assert names == MARKERS[1:-1]
    assert facts["import.times_from_fps"] == "120"
    np.testing.assert_allclose(values[3], angles[3], atol=1e-12)
    hidden = np.delete(angles, np.s_[100:110], axis=1)
    for k in (0, 1, 2):  # its own angle and those beside it
        np.testing.assert_allclose(values[k], hidden[k], atol=1e-12)
    np.testing.assert_array_equal(np.diff(t_ns[3]) // 1000, 8333)
    result = json.loads(command("analyse", tmp_path / "eel.mcap", "--json").out)
    (wave,) = result["free_motion"]["waves"]
    assert wave["wave_number"] == pytest.approx(LAG, abs=1e-3)
    assert wave["direction"] == "first-to-last"
    assert "a wave runs from neck to mid3" in result["answer"]["sentence"]


@pytest.mark.parametrize(
    ("x", "y"), [("{}_x", "{}_y"), ("{}.X", "{}.Y"), ("x_{}", "y_{}"), ("{} x", "{} y")]
)
def test_names_of_other_tools_are_read(tmp_path, command, x, y):
    angles, points = swimmer(2.0)
    table = {"time [s]": np.arange(angles.shape[1]) / FPS}
    for name, (xs, ys) in zip(MARKERS, points, strict=True):
        table |= {x.format(name): xs, y.format(name): ys}
    pd.DataFrame(table).to_csv(tmp_path / "t.csv", index=False)
    command("import", tmp_path / "t.csv", "-o", tmp_path / "t.mcap")
    names, _, values, _ = joints_of(tmp_path / "t.mcap")
    assert names == MARKERS[1:-1]
    np.testing.assert_allclose(values, angles, atol=1e-12)


def test_numbered_points_and_a_column_of_frames(tmp_path, command):
    angles, points = swimmer(2.0)
    table = {"frame": np.arange(10, 10 + angles.shape[1])}
    for k, (xs, ys) in enumerate(points, start=1):
        table |= {f"x{k}": xs, f"y{k}": ys}
    pd.DataFrame(table).drop(index=5).to_csv(tmp_path / "t.csv", index=False)
    error = command("import", tmp_path / "t.csv", "-o", tmp_path / "t.mcap", code=1).err
    assert "--fps" in error
    command("import", tmp_path / "t.csv", "-o", tmp_path / "t.mcap", "--fps", "120")
    names, t_ns, values, _ = joints_of(tmp_path / "t.mcap")
    assert names == ("marker2", "marker3", "marker4", "marker5")
    np.testing.assert_allclose(values, np.delete(angles, 5, axis=1), atol=1e-12)
    steps = np.diff(t_ns[0])
    assert np.flatnonzero(steps > 1.5e9 / FPS).tolist() == [4]


def test_a_rate_for_a_table_with_times_is_refused(tmp_path, command):
    pd.DataFrame({"time": [0.0, 0.1], "pos1": [1.0, 2.0]}).to_csv(tmp_path / "t.csv", index=False)
    error = command("import", tmp_path / "t.csv", "-o", tmp_path / "t.mcap", "--fps", "3", code=2)
    assert "has times (time); --fps is for tables without" in error.err


def test_arrays_without_times_take_a_rate(tmp_path, command):
    np.savez(tmp_path / "a.npz", joint_pos=np.arange(40.0).reshape(20, 2))
    command("import", tmp_path / "a.npz", "-o", tmp_path / "a.mcap", "--fps", "50")
    _, t_ns, values, _ = joints_of(tmp_path / "a.mcap")
    assert np.unique(np.diff(t_ns[0])).tolist() == [20_000_000]
    np.testing.assert_array_equal(values[1], np.arange(1.0, 40.0, 2.0))


@pytest.mark.parametrize("column", ["mid1_x", "mid1_likelihood"])
def test_a_point_without_numbers_is_named(tmp_path, command, column):
    _, points = swimmer(1.0)
    table = {"time [s]": np.arange(points.shape[2]) / FPS}
    for name, (x, y) in zip(MARKERS, points, strict=True):
        table |= {f"{name}_x": x, f"{name}_y": y, f"{name}_likelihood": np.ones_like(x)}
    frame = pd.DataFrame(table).astype({column: object})
    frame.loc[7, column] = "44.0@0-000"
    frame.to_csv(tmp_path / "t.csv", index=False)
    error = command("import", tmp_path / "t.csv", "-o", tmp_path / "t.mcap", code=1).err
    assert "t.csv" in error
    assert "44.0@0-000" in error
    assert not (tmp_path / "t.mcap").exists()
