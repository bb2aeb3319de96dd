"""Fleets whose truth is known: a joint that wears from a day on, or none."""

import json
from itertools import combinations

import fleet_tables
import numpy as np
import pandas as pd
import pytest

from support.linear_chain import CHAIN, WAVE, M, write_run
from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.change_points import JudgedQuantity
from undulog.analysis.catalog.fleet import Components, analyse_fleet

pytestmark = pytest.mark.nightly

DAY_NS = 86_400_000_000_000
FIRST = pd.Timestamp("2026-09-01")


def wear(kind, age_days):
    """Share of the full change, by the time since it began."""
    after = np.maximum(age_days, 0.0)
    return {
        "none": 0.0 * after,
        "step": (age_days > 0).astype(float),
        "ramp": after / 30,
        "saturating": 1 - np.exp(-after / 7),
    }[kind]


def frames(seed, kind="none", *, size=0.05, n=60, joints=13, gaits=1):
    """Sessions and joints as the catalogue has them; who wears, and since when."""
    rng = np.random.default_rng(seed)
    days = np.sort(rng.uniform(0, 60, n))
    paths = [f"run{k:03d}.mcap" for k in range(n)]
    names = [f"joint{k:02d}" for k in range(1, joints + 1)]
    at, worn = int(rng.integers(10, n - 10)), int(rng.integers(joints))
    begun = (days[at - 1] + days[at]) / 2

    def values(mean, alone, shared, noise):
        of_joints = mean + alone * rng.normal(size=joints)
        of_sessions = shared * rng.normal(size=n)[:, None]
        return of_joints + of_sessions + noise * rng.normal(size=(n, joints))

    gait = rng.integers(0, gaits, n)
    gain = values(0.9, 0.05, 0.03, 0.01) + 0.03 * gait[:, None] * rng.normal(size=joints)
    lag, power = values(0.1, 0.02, 0.02, 0.01), np.exp(values(0, 0.2, 0.1, 0.03))
    gain[:, worn] -= size * wear(kind, days - begun)
    sessions = pd.DataFrame(
        {
            "path": paths,
            "status": "analysed",
            "robot": "snake13",
            "start": FIRST + pd.to_timedelta(days * DAY_NS, unit="ns"),
            "duration_s": 16.0,
            "lag_sd": lag.std(axis=1),
            "gain_cv": gain.std(axis=1),
            "energy_cv": power.std(axis=1),
            "cost_of_transport": np.nan,
            "distance_m": np.nan,
            "frequency_hz": 0.5,
            "changes": None,
        }
    )
    rows = pd.DataFrame(
        {
            "path": np.repeat(paths, joints),
            "joint": np.tile(names, n),
            "position": np.tile(np.arange(joints), n),
            "gain": gain.ravel(),
            "lag_rad": lag.ravel(),
            "energy_abs_j": 8 * power.ravel(),
            "start_s": 8.0,
            "stop_s": 16.0,
            "command_amplitude_rad": np.repeat(0.3 + 0.1 * gait, joints),
            "frequency_hz": 0.5,
        }
    )
    return sessions, rows, names[worn], FIRST + pd.Timedelta(days=begun)


@pytest.fixture
def without_models(monkeypatch):
    """Leave out the mixed-effects models, which take most of the time."""
    monkeypatch.setattr(
        "undulog.analysis.catalog.fleet._components", lambda name, *_: Components(name)
    )


@pytest.fixture
def without_changes(monkeypatch):
    """Look for no changes, which takes the rest."""
    monkeypatch.setattr(
        "undulog.analysis.catalog.fleet.find_change_points",
        lambda series, *_: [JudgedQuantity()] * len(series),
    )


@pytest.fixture
def few_simulations(monkeypatch):
    """Simulate a fifth of the fleets, which takes a fifth of the time."""
    monkeypatch.setattr("undulog.analysis.catalog.change_points._SIMULATIONS", 199)
    monkeypatch.setattr("undulog.analysis.catalog.session_noise._DRAWS", (50, 50))


def test_a_worn_joint_is_named_with_its_date(without_models, few_simulations):
    sessions, rows, name, begun = frames(3, "step", n=40, joints=7)
    fleet = analyse_fleet(sessions, rows)
    (change,) = fleet.robots[0].changes
    assert (change.joint, change.quantity, change.gradual) == (name, "gain", False)
    assert change.earliest <= begun.isoformat() <= change.latest
    assert change.change == pytest.approx(-0.055, abs=0.01)
    assert f"the gain of {name} falls by" in fleet.answer
    assert f"from {change.date[:10]} on" in fleet.answer
    assert "lag-one correlation of sessions: gain 0.0" in fleet.answer


def test_an_offset_that_moved_is_named_with_its_date(without_models, few_simulations):
    """The commands are no gait: gains, lags in seconds and offsets are those of any motion."""
    sessions, rows, name, begun = frames(3, "none", n=40, joints=7)
    rng, moved = np.random.default_rng(4), (rows["joint"] == name).to_numpy()
    late = np.repeat((sessions["start"] > begun).to_numpy(), 7)
    rows = rows.rename(columns={"gain": "tracking_gain", "lag_rad": "tracking_lag_s"}).assign(
        gain=np.nan,
        lag_rad=np.nan,
        offset_rad=np.where(moved & late, np.radians(5.1), 0.0)
        + np.radians(0.3) * rng.standard_normal(len(rows)),
        command_mean_rad=0.0,
        commanded_range_rad=1.0,
        command_speed_rad_s=1.0,
    )
    fleet = analyse_fleet(sessions, rows)
    (change,) = fleet.robots[0].changes
    assert (change.joint, change.quantity, change.gradual) == (name, "offset", False)
    assert change.earliest <= begun.isoformat() <= change.latest
    assert change.change_ci95[0] < np.radians(5.1) < change.change_ci95[1]
    assert f"the offset of {name} moved by +5" in fleet.answer


@pytest.mark.nightly
def test_variance_components_are_those_planted():
    sessions, rows, _, _ = frames(8)
    (robot,) = analyse_fleet(sessions, rows).robots
    by_name = {component.quantity: component for component in robot.components}
    assert by_name["lag"].residual == pytest.approx(0.01, rel=0.1)
    assert by_name["lag"].session == pytest.approx(0.02, rel=0.3)
    assert by_name["energy"].joint == pytest.approx(0.2, rel=0.6)
    assert robot.changes == ()


def test_a_trend_is_that_planted(without_models, without_changes):
    sessions, rows, _, _ = frames(8)
    days = (sessions.start - FIRST) / pd.Timedelta(days=1)
    drifting = sessions.assign(lag_sd=0.01 + 0.001 * days)
    trends = {trend.quantity: trend for trend in analyse_fleet(drifting, rows).robots[0].trends}
    assert trends["lag_sd"].tau == 1.0
    assert trends["lag_sd"].p < 1e-6
    low, high = trends["lag_sd"].slope_ci95
    assert trends["lag_sd"].slope == pytest.approx(0.001)
    assert low - 1e-9 <= 0.001 <= high + 1e-9


def test_results_of_a_sweep_are_held_against_its_parameters(without_models, without_changes):
    sessions, rows, _, _ = frames(3)
    torque = np.random.default_rng(0).permutation(np.geomspace(0.2, 1.0, len(sessions)))
    swept = sessions.assign(
        lag_sd=0.02 / torque,
        changes=[json.dumps({"servo.stall_torque": t, "robot": "snake13"}) for t in torque],
    )
    trends = {(t.quantity, t.against): t for t in analyse_fleet(swept, rows).robots[0].trends}
    trend = trends["lag_sd", "servo.stall_torque"]
    assert (trend.tau, trend.sessions) == (-1.0, len(sessions))
    assert trend.p < 1e-6
    pairs = [
        (y - x) / (b - a)
        for (a, x), (b, y) in combinations(zip(torque, 0.02 / torque, strict=True), 2)
    ]
    assert trend.slope == pytest.approx(np.median(pairs))
    assert trends["lag_sd", "date"].p > 0.05


def test_an_odd_session_is_an_outlier_and_no_change(without_models, few_simulations):
    sessions, rows, _, _ = frames(5, n=40, joints=7)
    at = (rows.path == "run030.mcap") & (rows.joint == "joint04")
    rows.loc[at, "lag_rad"] += 0.2
    (robot,) = analyse_fleet(sessions, rows).robots
    assert robot.changes == ()
    first = robot.outliers[0]
    assert (first.path, first.joint, first.quantity) == ("run030.mcap", "joint04", "lag")
    assert first.deviation == pytest.approx(0.2, abs=0.04)


def test_incomplete_sessions_are_reported(without_models, without_changes):
    sessions, rows, _, _ = frames(1, n=40)
    partly = sessions.assign(status=np.where(np.arange(40) < 4, "not analysed", "analysed"))
    gone = (rows.path == "run020.mcap") | ((rows.path == "run021.mcap") & (rows.position == 3))
    result = analyse_fleet(partly, rows[~gone])
    assert result.robots[0].sessions == 35
    assert "1 sessions lack the response of a joint" in result.robots[0].warnings
    assert "1 sessions lack the response of most joints" in result.robots[0].warnings
    assert "4 sessions are not analysed" in result.warnings[0]


def test_sessions_that_have_a_gait_of_their_own_decide_nothing(without_models, few_simulations):
    sessions, rows, _, _ = frames(1, n=30, joints=5)
    numbers = rows.path.str[3:6].astype(int)
    fleet = analyse_fleet(sessions, rows.assign(frequency_hz=1.1**numbers))
    assert "gain not decided, 30 of about 31 sessions" in fleet.answer
    assert "no joint changes" not in fleet.answer


def test_robots_of_one_name_are_separated_by_their_serial_numbers(without_models, few_simulations):
    sessions, rows, _, _ = frames(1, n=40, joints=5)
    odd = np.arange(40) % 2 == 1
    other = rows.path.isin(sessions.path[odd]) & (rows.joint == "joint02")
    rows.loc[other, "gain"] *= 0.8  # two robots that differ, recorded in turn
    numbered = sessions.assign(serial=np.where(odd, "0002", "0001"))
    fleet = analyse_fleet(numbered, rows)
    assert [(robot.robot, robot.serial) for robot in fleet.robots] == [
        ("snake13", "0001"),
        ("snake13", "0002"),
    ]
    assert all(robot.changes == robot.outliers == robot.warnings == () for robot in fleet.robots)
    assert "snake13 (0002): no joint changes over 20 sessions" in fleet.answer
    (mixed,) = analyse_fleet(sessions, rows).robots
    assert mixed.warnings == ("snake13: taken as one robot by its name, without a serial number",)


def test_few_sessions_decide_nothing(without_models, few_simulations):
    sessions, rows, _, _ = frames(1, n=40)
    few = analyse_fleet(sessions.head(3), rows)
    assert few.robots == ()
    assert "not decided, 3 of at least 8 analysed sessions" in few.answer
    noisy = rows.assign(gain=rows.gain * np.exp(np.random.default_rng(1).normal(0, 0.1, len(rows))))
    fleet = analyse_fleet(sessions.head(12), noisy[noisy.path.isin(sessions.path.head(12))])
    gain = next(memory for memory in fleet.robots[0].memory if memory.quantity == "gain")
    assert gain.sessions_needed > 100
    assert f"gain not decided, 12 of about {gain.sessions_needed} sessions" in fleet.answer


@pytest.mark.nightly
def test_without_wear_hardly_a_joint_is_named(without_models):
    named = 0
    for seed in range(50):
        sessions, rows, _, _ = frames(seed, gaits=3)
        named += bool(analyse_fleet(sessions, rows).robots[0].changes)
    assert named <= 2  # binomial, 1 %: 2 or fewer in 99 %


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["step", "ramp", "saturating"])
def test_wear_is_named_with_a_date_whose_interval_holds(without_models, kind):
    good = 0
    for seed in range(50):
        sessions, rows, name, begun = frames(seed, kind, size=0.06)
        changes = analyse_fleet(sessions, rows).robots[0].changes
        mine = [change for change in changes if (change.joint, change.quantity) == (name, "gain")]
        good += any(change.earliest <= begun.isoformat() <= change.latest for change in mine)
    assert good >= {"step": 45, "ramp": 28, "saturating": 42}[kind]


@pytest.mark.nightly
def test_of_fifty_folders_of_sessions_without_changes_hardly_any_has_one(tmp_path, without_models):
    claimed = 0
    for seed in range(50):
        rng, case = np.random.default_rng(seed), fleet_tables.Case("", 0.3)
        gain, lag = (0.01 * fleet_tables.noise(rng, (20, M), case) for _ in range(2))
        folder = tmp_path / f"{seed}"
        folder.mkdir()
        for k, factors in enumerate(np.exp(gain - 1j * lag)):
            answer = factors * (CHAIN @ WAVE)
            write_run(folder / f"run{k:02d}.mcap", WAVE, answer, 20 * seed + k, 0.003)
        lab = Catalog(str(folder))
        lab.scan()
        assert lab.analyse(workers=2) == {}
        (robot,) = analyse_fleet(lab.find(), lab.find(joints=True)).robots
        claimed += bool(robot.changes or robot.outliers)
    assert claimed <= 3  # binomial, 1 %: 3 or fewer in 99 %


@pytest.mark.nightly
def test_the_page_of_a_folder_names_the_joint_and_links_outliers(tmp_path, command, report_of):
    for number in range(12):
        weak = np.diag(np.where(np.arange(M) == 2, 0.8 if number >= 6 else 1.0, 1.0))
        answer = weak @ CHAIN @ WAVE
        if number == 3:
            answer[1] *= np.exp(-0.3j)
        write_run(tmp_path / f"run{number:02d}.mcap", WAVE, answer, number, 0.003)
    (tmp_path / "run03.html").write_text("its page")
    page = tmp_path / "fleet.html"
    result = report_of("report", "--catalog", tmp_path, "-o", page)
    assert "the gain of j3 falls by" in result["answer"]
    text = page.read_text()
    for part in (
        result["answer"].split(":")[1].strip()[:20],
        '<a class="same" href="run03.mcap">',
        '<a href="run03.html">page</a>',
        "<svg",
    ):
        assert part in text
    assert "://" not in text.replace("http://www.w3.org", "")
    words = ("--catalog", tmp_path, "-o", page, "--force")
    command("report", tmp_path / "run00.mcap", *words, code=2)
