"""Pauses of a whole bus accuse no joint: found by what all joints do at once, and only then."""

import numpy as np
import pytest

from support.analysed import analysed
from support.joint_runs import write_joints
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.read.pauses import paused, without_pauses
from undulog.capture.log.read.sample_times import Signal

RATE_HZ, JOINTS = 100, 9
NAMES = [f"m{k:02d}" for k in range(JOINTS)]
STEP_NS = 10**9 // RATE_HZ


def gait(seconds=24, noise=0.002, step_rad=0.6):
    """Commands and positions, each of shape (n, m)."""
    turn = 2 * np.pi * 0.8 * np.arange(seconds * RATE_HZ)[:, None] / RATE_HZ
    place = np.arange(JOINTS)
    commands = 0.4 * np.sin(turn - step_rad * place)
    positions = 0.37 * np.sin(turn - step_rad * place - 0.2)
    return commands, positions + noise * np.random.default_rng(1).normal(size=positions.shape)


def held(positions, spans, joints=slice(None)):
    """The same with the last value repeated from each start to its stop [s]."""
    kept = positions.copy()
    for start, stop in spans:
        i, j = round(start * RATE_HZ), round(stop * RATE_HZ)
        kept[i:j, joints] = kept[i - 1, joints]
    return kept


def signals(values):
    t_ns = np.arange(len(values), dtype=np.int64) * STEP_NS
    return {n: Signal(n, "rad", t_ns, values[:, k]) for k, n in enumerate(NAMES)}


def pauses_s(commands, positions):
    """Begin and end of each pause [s]."""
    return without_pauses(signals(commands), signals(positions))[0] * 1e-9


SPANS = [(5.0, 6.5), (11.0, 11.2), (17.0, 20.0)]


def test_each_pause_is_found_from_its_first_repeat_to_the_next_new_value():
    commands, positions = gait()
    spans = pauses_s(commands, held(positions, SPANS))
    assert spans == pytest.approx(np.array([(start - 0.01, stop) for start, stop in SPANS]))
    runs = paused(np.arange(2400) * STEP_NS, held(positions, SPANS).T)
    assert runs.tolist() == [[round(100 * start), round(100 * stop)] for start, stop in SPANS]


def test_samples_of_a_pause_are_left_out_of_all_that_share_their_times():
    commands, positions = gait()
    measured = signals(held(positions, SPANS))
    t_ns = measured["m00"].t_ns
    rates = {n: Signal(n, "rad/s", t_ns, signal.values) for n, signal in measured.items()}
    apart = {n: Signal(n, "A", t_ns + 1, signal.values) for n, signal in measured.items()}
    _, (left, left_rates, left_apart) = without_pauses(signals(commands), measured, rates, apart)
    gone = [k for start, stop in SPANS for k in range(round(100 * start), round(100 * stop))]
    kept = np.setdiff1d(np.arange(2400), gone)
    for name in NAMES:
        assert left[name].t_ns.tolist() == t_ns[kept].tolist()
        assert left_rates[name].t_ns is left["m00"].t_ns
        assert left_rates[name].values.tolist() == rates[name].values[kept].tolist()
    assert left_apart == apart


def stairs(delay):
    """Steps of all joints, each second, and a servo that answers within a sample or two."""
    t = np.arange(24 * RATE_HZ)
    steps = np.where(np.random.default_rng(2).random((24, JOINTS)) > 0.5, 0.2, -0.2)
    commands = steps[t // RATE_HZ]
    late = steps[np.maximum(t - delay, 0) // RATE_HZ]
    positions = late.copy()
    for k in range(1, len(t)):
        positions[k] = positions[k - 1] + 0.86 * (late[k] - positions[k - 1])
    return commands, np.round(positions, 9)


def stopped(seconds):
    """An emergency stop of all joints, from which they start where they are."""
    commands, _ = gait()
    positions = np.zeros_like(commands)
    for k in range(1, len(commands)):
        moving = not 9.0 <= k / RATE_HZ < 9.0 + seconds
        way = np.clip(commands[k] - positions[k - 1], -0.03, 0.03)
        positions[k] = positions[k - 1] + moving * way
    return commands, positions


@pytest.mark.parametrize(
    ("commands", "positions"),
    [
        gait(),
        gait(noise=0.0, step_rad=0.0),
        (gait()[0], np.round(gait(noise=0.0, step_rad=0.0)[1] / 0.05) * 0.05),  # a coarse encoder
        (gait()[0], np.repeat(gait()[1][::20], 20, axis=0)),  # read five times a second
        (gait()[0], held(gait()[1], SPANS, slice(0, 8))),  # the last joint goes on
        (gait()[0], held(gait()[1], [(20.0, 24.0)])),  # to the end: the robot may be off
        (gait()[0], np.zeros((2400, JOINTS))),
        stairs(0),
        stairs(10),
        stopped(2.0),
    ],
    ids=[
        "sound",
        "in phase",
        "coarse",
        "slow",
        "alone",
        "to the end",
        "dead",
        "stairs",
        "late",
        "stop",
    ],
)
def test_what_joints_do_themselves_is_no_pause(commands, positions):
    assert pauses_s(commands, positions).size == 0


def test_without_commands_or_with_times_of_their_own_no_pause_is_told():
    commands, positions = gait()
    measured = signals(held(positions, SPANS))
    assert without_pauses({}, measured)[0].size == 0
    copies = {
        n: Signal(n, "rad", signal.t_ns.copy(), signal.values) for n, signal in measured.items()
    }
    assert without_pauses(signals(commands), copies)[0].size == 0
    assert without_pauses(signals(commands), {})[1] == [{}]


@pytest.mark.parametrize(
    "spans",
    [SPANS, [(9.0, 11.0)], [(k + 0.1 * (k % 3), k + 0.1 * (k % 3) + 0.25) for k in range(2, 22)]],
    ids=["three", "one", "many"],
)
def test_the_analysis_of_a_session_with_pauses_accuses_no_joint_and_has_its_gains(tmp_path, spans):
    commands, positions = gait()
    measured = held(positions, spans)
    still = np.zeros_like(measured)
    path = tmp_path / "run.mcap"
    write_joints(path, NAMES, commands, (measured, still, still), rate_hz=RATE_HZ)
    result = analysed(path)
    assert result.answer.not_following == ()
    assert [joint.gain.value for joint in result.joints] == pytest.approx([0.925] * 9, abs=2e-3)
    assert np.degrees([joint.lag_rad.value for joint in result.joints]) == pytest.approx(
        [np.degrees(0.2)] * 9, abs=0.2
    )
    (warning,) = [
        warning for warning in result.warnings if "repeat their values together" in warning
    ]
    lasted = sum(stop - start + 0.01 for start, stop in spans)
    assert f"for {lasted:.3g} s, in {len(spans)} pause" in warning


def test_the_check_names_the_bus_where_all_joints_freeze_and_a_joint_where_one_does(tmp_path):
    commands, positions = gait()
    for name, joints in (("all", slice(None)), ("one", 3)):
        measured = held(positions, [(9.0, 12.0)], joints)
        still = np.zeros_like(measured)
        path = tmp_path / f"{name}.mcap"
        write_joints(path, NAMES, commands, (measured, still, still), rate_hz=RATE_HZ)
        sentences = [finding.sentence for finding in check_session(path).findings]
        together = [
            sentence
            for sentence in sentences
            if "all joints repeat their values for 3 s" in sentence
        ]
        assert len(together) == (name == "all")
        assert not [sentence for sentence in sentences if "are frozen or missing" in sentence]
        frozen = [sentence for sentence in sentences if "frozen for 3 s" in sentence]
        assert len(frozen) == (name == "one")


def test_joints_that_are_frozen_for_most_of_the_session_stay_dead_in_the_check(tmp_path):
    commands, positions = gait()
    measured = held(positions, [(2.0, 24.0)])
    still = np.zeros_like(measured)
    path = write_joints(
        tmp_path / "run.mcap", NAMES, commands, (measured, still, still), rate_hz=RATE_HZ
    )
    health = check_session(path)
    assert health.verdict == "bad"
    assert "9 of 9 joints are frozen or missing" in [
        finding.sentence for finding in health.findings
    ]
