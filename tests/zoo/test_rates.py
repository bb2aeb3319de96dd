"""The bench itself: rows, resumption, limits; statements in memory against those of a file."""

import json

import numpy as np
import pytest

from support.joint_runs import write_joints
from support.paths import DOCS, SHARED
from undulog.analysis.session.analyse import analyse_session
from undulog.capture.common.errors import DataError
from zoo import adapter, rates, real_faults, recorded_page
from zoo.adapter import Accused, Said, Signals, stated
from zoo.independent_fit import independent_fit
from zoo.planted_faults import draw, record
from zoo.rates_table import least, most, table
from zoo.recordings import recordings

NOTHING = Said((), (), shaped=False, alike=False, not_decided=True, sentence="")


def arrays(m=5, seed=1, rate_hz=50, seconds=20):
    """Return a healthy gait with whole ns between samples."""
    rng, t_s = np.random.default_rng(seed), np.arange(rate_hz * seconds) / rate_hz
    angle = 2 * np.pi * 0.7 * t_s[:, None] - 0.8 * np.arange(m)
    positions = 0.36 * np.sin(angle - 0.1) + 0.002 * rng.normal(size=angle.shape)
    return tuple(f"joint{j + 1}" for j in range(m)), t_s, 0.4 * np.sin(angle), positions


@pytest.mark.parametrize("case", ["healthy", "jammed", "weak", "with efforts"])
def test_a_session_in_memory_states_what_its_file_states(tmp_path, opened, case):
    names, t_s, commands, positions = arrays()
    if case == "jammed":
        positions[500:, 2] = positions[500, 2] + 0.002 * np.sin(np.arange(500.0) ** 2)
    if case == "weak":
        positions[:, 1] *= 0.8
    efforts = 8 * (commands - positions) if case == "with efforts" else None
    statement = stated(Signals(names, t_s, commands, positions, efforts))
    states = (positions, np.gradient(positions, t_s, axis=0), efforts)
    path = write_joints(
        tmp_path / "run.mcap", names, commands, states if efforts is not None else states[:1]
    )
    answer = analyse_session(opened(path)).answer
    assert statement.sentence == answer.sentence
    assert [a.joint for a in statement.accused] == [f.joint for f in answer.not_following]
    differences = (*answer.stand_out, *answer.changes, *answer.extra, *answer.rests)
    assert [d.joint for d in statement.different] == [d.joint for d in differences]
    assert statement.alike == bool(answer.alike)
    assert not statement.shaped
    if case == "jammed":
        assert statement.accused[0].joint == "joint3"


def test_a_shape_counts_where_the_sentence_states_it():
    names, t_s, commands, positions = arrays(9)
    positions *= 1 - 0.08 * np.arange(9) / 8
    statement = stated(Signals(names, t_s, commands, positions))
    assert statement.shaped
    assert not statement.alike


def test_a_description_gives_the_planes_of_the_joints():
    robot = draw("described_planes", 1)
    signals = record(robot, seed=1)
    planes = [str(joint.plane) for joint in signals.description.joints]
    assert planes[:3] == ["horizontal", "vertical", "horizontal"]
    assert signals.description.joint_names == robot.names
    assert stated(signals).sentence


def test_a_session_that_is_refused_says_why(monkeypatch):
    def refuse(*_, **more):
        raise DataError("no samples")

    monkeypatch.setattr(adapter, "measure_session", refuse)
    statement = stated(Signals(*arrays()))
    assert statement.not_decided
    assert statement.refused == "no samples"


def test_limits_are_those_of_the_binomial_distribution():
    assert most(0.01, 2000) == 31
    assert most(0.01, 0) == 0
    assert least(0.95, 100) == 89  # P(89 or more of 100) = 99.6 %, P(90 or more) = 98.9 %
    assert least(0.95, 1) == 0


def row(fault="healthy", kind="white", seed=0, **more):
    usual = {
        "seen": True,
        "halves": 3.0,
        "accusations": [],
        "differences": [],
        "alike": False,
        "right": True,
    }
    return {"fault": fault, "kind": kind, "seed": seed, **usual, **more}


def test_the_table_marks_what_fails():
    good = [row(seed=k) for k in range(100)]
    lines, is_met = table(good)
    assert is_met
    assert lines[1].split()[:2] == ["white", "100"]
    bad = good[:90] + [row(seed=k, accusations=["joint1"]) for k in range(90, 100)]
    lines, is_met = table(bad)
    assert not is_met
    assert "10       (4)" in lines[1]
    assert lines[1].endswith("FAILS")


def test_differences_of_unlike_joints_are_right_and_alike_is_wrong():
    shaped = [row(seed=k, shaped=True) for k in range(100)]
    assert not table(shaped)[1]
    unlike = [row(seed=k, differs=True, shaped=True, differences=["joint1"]) for k in range(100)]
    assert table(unlike)[1]
    alike = [row(seed=k, differs=True, unlike=True, alike=True) for k in range(100)]
    assert not table(alike)[1]
    within = [row(seed=k, differs=True, unlike=False, alike=True) for k in range(100)]
    assert table(within)[1]


def test_planted_faults_are_counted_without_those_that_could_not_be_planted():
    rows = [row("gain", "", k, joint=True, kind_right=True, onset=True) for k in range(50)]
    rows += [row("gain", "", k, seen=False) for k in range(50, 60)]
    lines, is_met = table(rows)
    assert is_met
    words = lines[1].split()
    assert words[:4] == ["gain", "50", "50", "(43)"]
    assert words[-1] == "10"


def test_smaller_faults_have_no_bar():
    rows = [row("gain", "", k, halves=2.0, right=False) for k in range(50)]
    assert table(rows)[1]
    assert not table([{**missed, "halves": 3.0} for missed in rows])[1]


def chosen(folder, *words):
    return rates.parsed(["--jobs", "1", "-o", str(folder), *words])


@pytest.fixture
def quick(monkeypatch):
    """Runs sessions in this process, whose statements say nothing."""

    class Here:
        def __init__(self, _):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def submit(self, function, task):
            from concurrent.futures import Future

            done = Future()
            done.set_result(function(task))
            return done

    monkeypatch.setattr(rates, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(rates, "stated", lambda signals: NOTHING)


def test_a_run_goes_on_behind_its_last_row(tmp_path, quick, monkeypatch):
    words = ["--kinds", "white", "ar90", "--faults", "still", "--base", "white", "--seeds", "2"]
    rows = rates.run(chosen(tmp_path, *words))
    assert len(rows) == 6
    path = tmp_path / "rows.jsonl"
    lines = path.read_text().splitlines()
    assert [json.loads(line)["fault"] for line in lines].count("still") == 2
    path.write_text("\n".join(lines[:4]) + '\n{"fault": "hea')  # killed while it wrote
    again = []
    run_task = rates.run_task
    monkeypatch.setattr(rates, "run_task", lambda task: again.append(task) or run_task(task))
    assert rates.run(chosen(tmp_path, *words)) == rows
    assert len(again) == 2
    assert rates.run(chosen(tmp_path, *words)) == rows
    assert len(again) == 2


def test_a_session_on_which_the_product_fails_is_wrong(monkeypatch):
    def fail(signals):
        raise ZeroDivisionError

    monkeypatch.setattr(rates, "stated", fail)
    result = rates.run_task(rates.Task("healthy", "white", 0))
    assert "ZeroDivisionError" in result["error"]
    assert not result["right"]


def test_the_product_is_asked_about_a_drawn_session():
    result = rates.run_task(rates.Task("healthy", "few_joints", 1))
    assert result["joints"] == 3
    assert result["sentence"]


def gait_signals(rate_hz=50, seconds=40):
    names, t_s, commands, positions = arrays(4, rate_hz=rate_hz, seconds=seconds)
    return Signals(names, t_s, commands, positions)


@pytest.mark.parametrize("name", real_faults.FAULTS)
def test_a_fault_in_a_recording_is_what_it_says(name):
    signals = gait_signals()
    assert real_faults.exposed_joints(signals) == [0, 1, 2, 3]
    fault = real_faults.FAULTS[name](signals, 2)
    before, after = signals.positions[:, 2], fault.positions[:, 2]
    np.testing.assert_array_equal(
        np.delete(fault.positions, 2, axis=1), np.delete(signals.positions, 2, axis=1)
    )
    since = signals.t_s >= (fault.truth.since_s or 0.0)
    np.testing.assert_array_equal(after[~since], before[~since])
    off = (after - before)[since]
    if name.startswith("offset"):
        np.testing.assert_allclose(np.degrees(off), 5.0)
    if name == "gain_from":
        assert np.ptp(after[since]) / np.ptp(before[since]) == pytest.approx(0.75, abs=1e-6)
    if name.startswith("lag"):
        fit = independent_fit(signals.t_s[since], before[since], after[since], (None, None))
        assert fit.delay_s == pytest.approx(0.1, abs=6e-3)
    if name == "vibration":
        assert np.degrees(off.std() * 2**0.5) == pytest.approx(3.0, rel=0.01)
    if name == "still":
        assert np.ptp(after) == 0
    if name == "held":
        inside = since & (signals.t_s < fault.truth.until_s)
        assert np.ptp(after[inside]) == 0
        assert inside.sum() == 100


def test_an_accusation_of_a_joint_that_follows_is_refuted():
    signals = gait_signals()
    accused = Accused("joint2", frozenset({"dead"}), 5.0, 12.0)
    assert rates._refuted(signals, accused)
    still = real_faults.faulty(signals, real_faults.FAULTS["still"](signals, 1))
    assert not rates._refuted(still, accused)


def test_what_is_stated_without_the_fault_is_no_answer_to_it(monkeypatch):
    """A joint that is accused as before isn't found; another accusation of it is."""
    signals = gait_signals()
    before = Accused("joint2", frozenset({"slipped"}), 20.0, None)
    usual = {"shaped": False, "alike": False, "not_decided": False, "sentence": "joint2 joint3"}
    as_it_is = Said((before,), (), **usual)
    monkeypatch.setattr(rates, "_recording", lambda name: (signals, as_it_is))
    right = {}
    for since_s in (20.2, 16.0):
        accused = Accused("joint2", frozenset({"slipped"}), since_s, None)
        monkeypatch.setattr(rates, "stated", lambda _, a=accused: Said((a,), (), **usual))
        right[since_s] = rates._recorded(rates.Task("offset_from", "kuka", 1))["right"]
    assert right == {20.2: False, 16.0: True}


needs_recordings = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no recordings in {SHARED}")


@needs_recordings
@pytest.mark.nightly
def test_the_manual_says_what_is_stated_of_recordings():
    page = (DOCS / "explanation/faults.md").read_text()
    assert "\n".join(recorded_page.lines()) in page, "renew it: python -m zoo.recorded_page"


BY_DAY = {"so101/chirp_sweep", "so101/pick_place", "go2/traj_0", "kuka"}
"""Recordings of other robots and motions; the others are for the night."""


@needs_recordings
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in BY_DAY else pytest.mark.nightly)
        for name in recordings()
    ],
)
def test_no_joint_of_a_sound_robot_is_accused(name):
    statement = stated(recordings()[name]())
    assert statement.accused == ()
    assert statement.doubted == ()


@needs_recordings
def test_recordings_are_read_as_their_page_describes_them():
    """Slopes and lags that others fitted."""
    readers = recordings()
    motor = readers["arcsnake/linear_trajectory"]()
    fit = independent_fit(*real_faults.columns(motor, 0), (3.0 + 1.0, 10.5 - 1.0))
    assert fit.gain == pytest.approx(1.0, abs=1e-3)
    assert fit.delay_s == pytest.approx(7.4e-3, abs=3e-3)
    robot = readers["kuka"]()
    assert robot.commands.shape == (2501, 6)
    slopes = [np.polyfit(*robot_columns(robot, j), 1)[0] for j in range(3)]
    assert all(1.003 < slope < 1.014 for slope in slopes)
    dog = readers["go2/traj_0"]()
    assert dog.names[:2] == ("FL_hip_joint", "FL_thigh_joint")
    assert np.median(np.diff(dog.t_s)) == pytest.approx(1 / 200, rel=0.01)
    arm = readers["so101/coupled_joints"]()
    assert arm.names[0] == "Rotation"
    assert arm.t_s[-1] == pytest.approx(120, abs=1)
    hands = readers["g1/episode_000000"]()
    assert hands.commands.shape[1] == 26
    assert hands.frame_rate_hz == 30


def robot_columns(signals, joint):
    return signals.commands[:, joint], signals.positions[:, joint]


def test_onsets_of_right_statements_have_a_bar_of_their_own():
    early = [row("gain_from", "", k, since_s=9.0, onset=k >= 10) for k in range(50)]
    lines, is_met = table(early)
    assert "(50, 40)" in lines[1]
    assert is_met
    assert not table([{**case, "onset": False} for case in early])[1]
