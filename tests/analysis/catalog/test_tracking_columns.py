"""Gain, lag and offset of any motion as columns of a catalogue, against planted truth."""

import numpy as np
import pytest

from support.analysed import analysed
from support.written_topics import EPOCH_NS, write_topics
from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.files import FOLDER
from undulog.analysis.catalog.rows import SCHEMAS, table_of
from undulog.capture.common.object_store import ObjectStore

NAMES, GAIN, LAG_S, OFFSET_RAD = ["a", "b", "c"], 0.9, 0.08, 0.05


def write(path, command):
    """Write a session of three joints with one command each, a function of time in columns."""
    t = np.arange(0.0, 20.0, 0.02)[:, None]
    noise = 0.002 * np.random.default_rng(1).standard_normal((t.size, 3))
    given = GAIN * command(t - LAG_S) + OFFSET_RAD + noise
    topics = {"/joint_commands": (NAMES, "rad", command(t)), "/joint_states": (NAMES, "rad", given)}
    write_topics(path, EPOCH_NS + np.rint(t.ravel() * 1e9).astype(np.int64), topics)
    return path


def tones(t_s):
    return sum(0.1 * np.sin(2 * np.pi * f * t_s + [0, f, 2 * f]) for f in (0.11, 0.23, 0.37, 0.61))


def gait(t_s):
    return 0.4 * np.sin(2 * np.pi * 0.5 * t_s + [0.0, 0.8, 1.6])


def test_joints_have_columns_of_any_motion(tmp_path):
    for name, command in (("work", tones), ("gait", gait)):
        path = write(tmp_path / f"{name}.mcap", command)
        analysed(path).save(tmp_path / f"{name}.json")
    lab = Catalog(tmp_path)
    lab.scan()
    rows = lab.find(joints=True).set_index(["path", "joint"])
    work, paced = rows.loc["work.mcap"], rows.loc["gait.mcap"]
    assert work["gain"].isna().all()
    assert paced["tracking_gain"].isna().all()
    assert work["tracking_lag_s"].to_numpy() == pytest.approx(LAG_S, abs=2e-3)
    assert (work["tracking_gain_low"] < GAIN).all()
    assert (work["tracking_gain_high"] > GAIN).all()
    assert (work["tracking_freedom"] > 8).all()
    for table in (work, paced):
        # The gain isn't 1: the offset holds that of the command's mean.
        truth = OFFSET_RAD - (1 - GAIN) * table["command_mean_rad"]
        assert (table["offset_rad"] - truth).abs().max() < 1e-3
        assert (table["offset_rad_low"] < table["offset_rad"]).all()


def test_rows_of_earlier_versions_lack_columns_which_are_null(tmp_path):
    names = [name for name in SCHEMAS["joints"].names if "tracking" not in name]
    row = {"source": "x", "joint": "a", "position": 0, "scanned_ns": 1, "removed": False}
    earlier = table_of("joints", [row]).select(names)
    store = ObjectStore(str(tmp_path))
    store.make_folders(f"{FOLDER}/joints")
    store.write_table(f"{FOLDER}/joints/new-1-x", earlier)
    rows = Catalog(tmp_path).find(joints=True)
    assert rows["joint"].to_list() == ["a"]
    assert rows["tracking_gain"].isna().all()
