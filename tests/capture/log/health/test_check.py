"""`undulog log check` against faults planted in the rhythm and the values of a clean session."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support import checked_sessions
from support.checked_sessions import (
    EPOCH_NS,
    NAMES,
    ROBOT,
    STEP_NS,
    TICKS,
    at,
    timing_of,
    write_raw,
)
from undulog.capture import SessionWriter
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.health.tallies import SequenceTally, TimingTally


@pytest.fixture
def write(tmp_path):
    """Writes sessions with faults, each to a file of its own."""
    paths = (tmp_path / f"{number}.mcap" for number in itertools.count())
    return lambda *how, **more: checked_sessions.write(next(paths), *how, **more)


def joint_of(health, name, topic="/joint_states"):
    (match,) = [joint for joint in health.joints if (joint.topic, joint.name) == (topic, name)]
    return match


# -- the clean twin ----------------------------------------------------------------------------


def test_a_clean_session_is_good_without_a_finding(clean, command):
    health = check_session(clean)
    assert (health.verdict, health.findings) == ("good", ())
    assert health.file.chunks == health.file.checked > 1
    timing = timing_of(health)
    assert (timing.count, timing.gaps, timing.missing) == (TICKS, 0, 0)
    assert timing.median_s == pytest.approx(0.01, abs=1e-12)
    assert timing.rate_hz == pytest.approx(100.0)
    assert timing.std_s == pytest.approx(0.0, abs=1e-6)
    assert {channel.sequence.kind for channel in health.channels} == {"counted"}
    assert {channel.sequence.dropped for channel in health.channels} == {0}
    assert joint_of(health, "joint07").frozen_s == 0
    report = command("log", "check", clean).out
    assert report.startswith("good: s, snake25, 19.99 s\n")
    assert "stored verdict: good, the same" in report
    assert "0 messages dropped in 2 channels" in report


@pytest.mark.slow
def test_json_is_one_object_and_has_whether_the_stored_verdict_differs(write, command):
    report = json.loads(command("log", "check", write(verdict="bad"), "--json").out)
    assert report["verdict"] == "good"
    stored = {"verdict": "bad", "reasons": ["as the recorder had it"], "differs": True}
    assert report["stored"] == stored
    assert len(report["joints"]) == 2 * len(NAMES)
    assert report["series"][0]["timing"]["rate_hz"] == pytest.approx(100.0)


# -- planted in the rhythm ---------------------------------------------------------------------


@pytest.mark.slow
def test_gaps_are_counted_measured_and_placed(write):
    lost = {*range(300, 303), 900, *range(1500, 1530)}
    health = check_session(write(lost=lambda tick: tick in lost))
    timing = timing_of(health)
    assert (timing.gaps, timing.missing) == (3, len(lost))
    assert timing.longest_s == pytest.approx(0.31)
    assert timing.longest_at_ns == at(1499)
    assert timing_of(health, "/joint_commands").gaps == 0
    assert health.verdict == "degraded"
    reason = "3 gaps, 34 samples missing (1.70%); the longest is 0.31 s, at 14.990 s"
    assert health.reasons == (f"/joint_states: {reason}",)


@pytest.mark.slow
def test_one_short_gap_is_noted_and_no_fault(write):
    health = check_session(write(lost=lambda tick: tick == 700))
    assert health.verdict == "good"
    assert "1 gaps, 1 samples missing" in health.notes[0]


@pytest.mark.slow
def test_a_tenth_lost_is_bad_and_exits_1(write, command):
    path = write(lost=lambda tick: tick % 8 == 1)
    assert check_session(path).verdict == "bad"
    command("log", "check", path, code=1)


@pytest.mark.slow
def test_a_pause_can_be_cut_out_unless_it_is_most_of_the_session(write):
    once = check_session(write(lost=lambda tick: 400 <= tick < 900))
    assert once.verdict == "degraded"
    assert timing_of(once).paused_s == pytest.approx(5.01)
    assert (timing_of(once).missing, timing_of(once).scattered) == (500, 0)
    assert check_session(write(lost=lambda tick: 400 <= tick < 1500)).verdict == "bad"


@pytest.mark.slow
def test_a_series_that_ends_early_is_reported(write):
    health = check_session(write(lost=lambda tick: tick >= 1500))
    assert health.reasons == ("/joint_states: ends 5 s before the session",)


@pytest.mark.slow
def test_repeated_and_backward_stamps_are_counted(write):
    def edit(tick, *_):
        return at(tick - (tick % 200 == 100) - 3 * (tick in {450, 850}))

    timing = timing_of(health := check_session(write(edit)))
    assert (timing.duplicates, timing.backward) == (10, 2)
    assert health.verdict == "degraded"


@pytest.mark.slow
def test_jitter_has_the_standard_deviation_that_was_planted(write):
    late = np.random.default_rng(11).normal(0.0, 3e5, TICKS).astype(int)

    steps = np.diff(at(0) + np.arange(TICKS) * STEP_NS + late) / 1e9
    timing = timing_of(check_session(write(lambda tick, *_: at(tick) + int(late[tick]))))
    assert timing.std_s == pytest.approx(steps.std(), rel=1e-3)
    assert timing.median_s == pytest.approx(np.median(steps), rel=0.011)
    assert timing.p99_s == pytest.approx(np.quantile(steps, 0.99), rel=0.011)


@given(
    st.lists(st.integers(1, 10**10), min_size=1, max_size=300),
    st.lists(st.integers(0, 300), max_size=4),
)
def test_blocks_don_t_change_a_timing(steps, cuts):
    t_ns = EPOCH_NS + np.cumsum([0, *steps])
    whole, pieces = TimingTally(), TimingTally()
    whole.add(t_ns)
    for part in np.split(t_ns, sorted(cuts)):
        pieces.add(part)
    single, many = whole.result(), pieces.result()
    assert (single.count, single.gaps, single.missing) == (many.count, many.gaps, many.missing)
    assert single.median_s == pytest.approx(many.median_s)
    assert single.longest_s == many.longest_s == max(steps) / 1e9
    median_s = np.quantile(steps, 0.5, method="inverted_cdf") / 1e9
    assert single.median_s == pytest.approx(median_s, rel=0.011)


# -- sequence numbers ------------------------------------------------------------------------------


def test_dropped_sequence_numbers_are_proved(tmp_path):
    kept = [k for k in range(1, 500) if k not in {100, 101, 350}]
    health = check_session(write_raw(tmp_path / "s.mcap", kept))
    assert {channel.sequence.dropped for channel in health.channels} == {3}
    assert health.verdict == "degraded"
    dropped = "3 of 499 messages were dropped (0.60%), as its sequence numbers prove"
    assert f"/joint_commands and /joint_states, each: {dropped}" in health.reasons


def test_zeros_are_no_sequence_numbers(tmp_path, command):
    path = write_raw(tmp_path / "s.mcap", [0] * 300)
    health = check_session(path)
    assert {channel.sequence.kind for channel in health.channels} == {"none"}
    assert {channel.sequence.dropped for channel in health.channels} == {None}
    assert "no sequence numbers, so drops can't be proved" in command("log", "check", path).out


@pytest.mark.parametrize(
    ("numbers", "kind", "dropped"),
    [
        ([2**32 - 2, 2**32 - 1, 0, 1], "counted", 0),
        ([5, 6, 7, 8, 10, 9, 11, 12, 13], "counted", 0),
        ([5, 6, 8, 9, 12], "counted", 3),
        ([7, 7, 7, 7], "not a count", None),
        ([3, 10, 17, 24], "not a count", None),
        ([4], "too few", None),
    ],
)
def test_what_sequence_numbers_prove(numbers, kind, dropped):
    tally = SequenceTally()
    for part in np.split(np.array(numbers), [1, 3]):
        tally.add(part)
    assert (tally.result().kind, tally.result().dropped) == (kind, dropped)


# -- planted in the values ---------------------------------------------------------------------


@pytest.mark.slow
def test_nan_is_counted_by_joint(write):
    def edit(tick, command, angles):
        angles[4] = np.nan if 100 <= tick < 150 else angles[4]

    health = check_session(write(edit))
    assert joint_of(health, "joint05").nan == 50
    assert sum(joint.nan for joint in health.joints) == 50
    assert health.reasons == ("/joint_states, joint05: 50 of 2000 samples are not a number",)


@pytest.mark.parametrize(
    ("axes", "reported"),
    [
        ("z", 0),  # not measured, and marked so as sensor_msgs/MagneticField has it
        ("x", 0),
        ("xyz", 3 * 200),  # then nothing is left of the sensor
    ],
)
def test_an_axis_that_is_never_measured_is_no_fault(tmp_path, axes, reported):
    path = tmp_path / "s.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        compass = writer.magnetic_field("/compass", frame="head")
        imu = writer.imu("/imu", frame="head")
        for tick in range(200):
            vector = np.full(3, 2e-5)
            vector[["xyz".index(axis) for axis in axes]] = np.nan
            compass.write(EPOCH_NS + tick * STEP_NS, vector)
            vector = np.array([0.0, np.nan if tick < 20 else 0.1, 9.8])
            imu.write(EPOCH_NS + tick * STEP_NS, vector)
    reasons = [reason for reason in check_session(path).reasons if "not a number" in reason]
    assert any(reason.startswith("/imu: 20 of ") for reason in reasons)
    compass = [reason.split(" of ")[0] for reason in reasons if reason.startswith("/compass")]
    assert compass == [f"/compass: {reported}"] * (reported > 0)


def test_a_frozen_joint_is_named_and_timed_and_a_resting_one_is_not(write):
    def edit(tick, command, angles):
        command[1], angles[1] = 0.0, 0.0  # it rests
        angles[6] = 0.123 if 480 <= tick < 1230 else angles[6]

    health = check_session(write(edit))
    assert joint_of(health, "joint07").frozen_s == 7  # whole seconds within 4.8 to 12.3 s
    assert joint_of(health, "joint07").frozen_at_ns == at(500)
    assert joint_of(health, "joint02").frozen_s == 0
    following, frozen = health.reasons
    assert frozen == "/joint_states, joint07: frozen for 7 s while its command moved, at 5.000 s"
    assert following.startswith("joint07 from 4.8 s to 12.3 s stands still while its command moves")
    assert following.endswith("its velocity goes on: frozen_sensor or dead")


@pytest.mark.slow
def test_half_of_the_joints_frozen_is_bad(write):
    def edit(tick, command, angles):
        angles[:13] = 0.1

    assert check_session(write(edit)).verdict == "bad"


@pytest.mark.slow
def test_a_joint_held_at_its_limit_is_named_and_a_full_stroke_is_not(write):
    limit = ROBOT.joints[0].upper

    def edit(tick, command, angles):
        angles[2] = command[2] = np.clip(2 * command[2], -limit, limit)
        angles[3] = command[3] = limit * np.sin(np.pi * tick / 100)

    health = check_session(write(edit))
    clipped = np.mean(np.abs(0.8 * np.sin(np.pi * np.arange(TICKS) / 100 - 1)) >= limit - 1e-3)
    assert joint_of(health, "joint03").at_limit == pytest.approx(clipped)
    touching = 2 / np.pi * np.arccos(1 - 1e-3 / limit)
    assert joint_of(health, "joint04").at_limit == pytest.approx(touching, abs=0.015)
    topics = {sentence.split(", ")[0] for sentence in health.reasons}
    assert topics in ({"/joint_states", "/joint_commands"}, {"/joint_commands and /joint_states"})
    assert all("joint03" in sentence and "joint04" not in sentence for sentence in health.reasons)
