"""Robots with few sessions, whose truth is planted: which joints differ from earlier ones."""

import numpy as np
import pandas as pd
import pytest

from undulog.analysis.catalog.earlier import departure_sentence, departures
from undulog.analysis.catalog.fleet import analyse_fleet
from undulog.analysis.catalog.joint_tables import conditions_of, values_of

JOINTS = [f"joint{k}" for k in range(1, 7)]
FIRST = pd.Timestamp("2026-11-01")
DEGREE = np.pi / 180
ERROR = {"tracking_gain": 0.001, "tracking_lag_s": 0.0005, "offset_rad": 0.02 * DEGREE}
HALF = 2.0  # of 60 degrees of freedom


def frames(rng, count, *, scatter=0.0, common=0.0, changes=None):
    """Return sessions of six unlike joints; changes of the last one by joint and column."""
    paths = [f"run{k}.mcap" for k in range(count)]
    size = (count, len(JOINTS))
    middles = {
        "tracking_gain": rng.uniform(0.7, 1.0, len(JOINTS)),
        "tracking_lag_s": rng.uniform(0.02, 0.2, len(JOINTS)),
        "offset_rad": rng.uniform(-10, 10, len(JOINTS)) * DEGREE,
    }
    scale = {"tracking_gain": 0.01, "tracking_lag_s": 0.003, "offset_rad": 0.3 * DEGREE}
    columns = {}
    for name, middle in middles.items():
        sessions = scatter * rng.standard_normal(size) + common * rng.standard_normal((count, 1))
        value = middle + scale[name] * sessions + ERROR[name] * rng.standard_normal(size)
        for joint, (changed, by) in (changes or {}).items():
            if changed == name:
                at = JOINTS.index(joint)
                value[-1, at] += by * middle[at] if name == "tracking_gain" else by
        half = HALF * ERROR[name]
        columns |= {name: value, f"{name}_low": value - half, f"{name}_high": value + half}
    sessions = pd.DataFrame(
        {
            "path": paths,
            "status": "analysed",
            "robot": "arm6",
            "serial": "SN7",
            "start": [FIRST + pd.Timedelta(days=k) for k in range(count)],
            "duration_s": 30.0,
        }
    )
    rows = pd.DataFrame({name: values.ravel() for name, values in columns.items()})
    rows = rows.assign(
        path=np.repeat(paths, len(JOINTS)),
        joint=np.tile(JOINTS, count),
        position=np.tile(np.arange(len(JOINTS)), count),
        tracking_freedom=60.0,
        commanded_range_rad=1.0,
        command_speed_rad_s=0.8,
        command_mean_rad=0.1,
        start_s=0.0,
        stop_s=30.0,
        **dict.fromkeys(("gain", "lag_rad", "energy_abs_j", "command_amplitude_rad"), np.nan),
        frequency_hz=np.nan,
    )
    return sessions, rows


def of_robot(sessions, rows):
    return departures("arm6", "SN7", sessions, rows)


def test_a_joint_of_two_sessions_differs_from_itself():
    changes = {"joint2": ("tracking_gain", -0.2), "joint4": ("offset_rad", 5.1 * DEGREE)}
    sessions, rows = frames(np.random.default_rng(1), 2, changes=changes)
    results = {joint.joint: joint for joint in of_robot(sessions, rows)}
    assert set(results) == {"joint2", "joint4"}
    low, high = results["joint4"].change_ci95
    assert low < 5.1 * DEGREE < high < low + 0.3 * DEGREE
    assert results["joint2"].change == pytest.approx(-0.2, abs=0.01)
    text = departure_sentence(results["joint2"])
    assert text.startswith("joint2 follows with 20 % [")
    assert "less than in 2026-11-01 (of two sessions: the interval holds the noise" in text
    text = departure_sentence(results["joint4"])
    assert text.startswith("the offset of joint4 moved by +5.1° [5")
    fleet = analyse_fleet(sessions, rows)
    assert fleet.answer.startswith("arm6 (SN7): ")
    assert "; 1 more difference." in fleet.answer
    assert len(fleet.to_dict()["departures"]) == 2


def test_with_several_earlier_sessions_their_scatter_counts():
    changes = {"joint4": ("offset_rad", 10 * DEGREE)}
    sessions, rows = frames(np.random.default_rng(2), 6, scatter=1.0, changes=changes)
    (result,) = of_robot(sessions, rows)
    assert (result.joint, result.quantity, result.earlier) == ("joint4", "offset", 5)
    assert departure_sentence(result).endswith("5 earlier sessions (2026-11-01 to 2026-11-05)")
    small = {"joint4": ("offset_rad", 1.2 * DEGREE)}
    assert of_robot(*frames(np.random.default_rng(2), 6, scatter=1.0, changes=small)) == []


def named(count, common, robots):
    """Count robots without changes of which a difference is stated.

    Of two sessions the sessions don't scatter: that isn't known of them.
    """
    rng = np.random.default_rng(count)
    scatter, common = (0.0, 0.0) if count == 2 else (1.0, common)
    drawn = (frames(rng, count, scatter=scatter, common=common) for _ in range(robots))
    return sum(bool(of_robot(*robot)) for robot in drawn)


@pytest.mark.parametrize("count", [2, 4])
def test_of_robots_without_changes_hardly_any_has_a_difference(count):
    """30 robots at 1 %: at most 2 (99 % of a binomial distribution)."""
    assert named(count, 3.0, 30) <= 2


@pytest.mark.nightly
@pytest.mark.parametrize("count", [2, 3, 4, 7])
@pytest.mark.parametrize("common", [0.0, 3.0])
def test_of_robots_without_changes_one_in_a_hundred_has_a_difference(count, common):
    """150 robots at 1 %: at most 5 (99 % of a binomial distribution)."""
    assert named(count, common, 150) <= 5


def test_what_is_within_the_margins_is_not_stated():
    changes = {"joint2": ("tracking_gain", -0.01), "joint4": ("offset_rad", 0.3 * DEGREE)}
    assert of_robot(*frames(np.random.default_rng(3), 2, changes=changes)) == []


def test_sessions_of_another_motion_are_not_compared():
    changes = {"joint2": ("tracking_gain", -0.2)}
    sessions, rows = frames(np.random.default_rng(4), 3, changes=changes)
    rows.loc[rows["path"] == "run2.mcap", "commanded_range_rad"] = 1.5
    assert conditions_of(rows, sessions.set_index("path")).tolist() == [0, 0, 1]
    assert of_robot(sessions, rows) == []


def test_offsets_are_those_of_one_command():
    """A joint with a gain of 0.9 stands 0.04 rad further off where its command is 0.4 rad more."""
    sessions, rows = frames(np.random.default_rng(5), 3)
    rows = rows.assign(tracking_gain=0.9, offset_rad=0.05)
    last = rows["path"] == "run2.mcap"
    rows.loc[last, ["command_mean_rad", "offset_rad"]] = 0.5, 0.01
    assert values_of(rows, sessions)["offset"].to_numpy() == pytest.approx(0.05)
    of_gaits = rows.assign(tracking_gain=np.nan)
    assert values_of(of_gaits, sessions)["offset"][last].isna().all()
