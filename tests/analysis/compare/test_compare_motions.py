"""Sessions without commands: chains whose motion is known in closed form, with white noise."""

import json
import re

import numpy as np
import pytest

from undulog.analysis import Choices, compare_sessions
from undulog.analysis.compare.decisions import Margins, decide, differ, estimates_of, family
from undulog.analysis.compare.quantities import common_motion, motion_estimates, motion_of
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.oscillation import fit_motion
from undulog.analysis.response.fitting import fit_gait
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import DataError

OMEGA = 2 * np.pi * 0.83
NOISE = 0.004
WAVE = 0.4 * np.exp(-0.7j * np.arange(6))
SECONDS, RATE = 10.0, 25.0
NAMES = [f"joint{k + 1:02d}" for k in range(6)]


class Side:
    """One session's estimates, without a session."""

    def __init__(self, estimates):
        self.estimates = estimates


def motion(amplitudes, seed, noise=NOISE, robot=None):
    rng = np.random.default_rng(seed)
    amplitudes = amplitudes * np.exp(1j * rng.uniform(0, 2 * np.pi))  # clocks share no zero
    t = np.arange(-SECONDS / 2, SECONDS / 2, 1 / RATE)
    series = {}
    names = NAMES if robot is None else robot.joint_names
    for name, amplitude in zip(names, amplitudes, strict=True):
        at = t + rng.uniform(0, 0.3 / RATE, t.size)
        angles = np.real(amplitude * np.exp(1j * OMEGA * at)) + 0.1
        series[name] = Series(name, at, angles + noise * rng.standard_normal(t.size))
    gait = fit_gait({}, series, SECONDS, lambda _: None)
    return motion_of(f"{seed}.mcap", robot, fit_motion(series, gait))


def decided(*motions):
    common = common_motion(motions)
    a, b = ([Side(motion_estimates(side_motion, common))] for side_motion in motions)
    keys = family(a, b, common.names)
    about = np.array([a[0].estimates[key][0] for key in keys])
    sides = [estimates_of(side, keys, about) for side in (a, b)]
    first, second, differences = differ(*sides, "sessions")
    return decide(keys, first, second, differences, Margins(), before=common.before)


def false_alarms(amplitudes, draws):
    """Share of pairs of one motion in which something differs beyond doubt."""
    results = [
        decided(motion(amplitudes, 2 * k), motion(amplitudes, 2 * k + 1)) for k in range(draws)
    ]
    return np.mean([any(d.p_holm < 0.05 for d in result.differences) for result in results])


WEAK = WAVE * np.array([1, 1, 1, 0.003, 1, 1])  # one joint barely above its noise
INVERTED = WAVE * np.array([1, 1, -1, 1, 1, 1])  # half a turn off the wave
STANDING = 0.4 * np.cos(0.5 * np.arange(6) + 0.2) + 0j
CIRCLE = 0.4 * np.exp(-1j * np.pi / 3 * np.arange(6))  # both semi-axes as long


@pytest.mark.nightly
def test_false_alarms_are_at_most_one_in_twenty():
    """3 of 60: more than 7 would be beyond binomial scatter of 5 %."""
    assert false_alarms(WAVE, 60) * 60 <= 7


@pytest.mark.nightly
@pytest.mark.parametrize("amplitudes", [WAVE, WEAK, INVERTED, STANDING, CIRCLE])
def test_false_alarms_of_any_motion(amplitudes):
    assert false_alarms(amplitudes, 150) <= 0.05 + 3 * (0.05 * 0.95 / 150) ** 0.5


@pytest.mark.nightly
def test_the_intervals_hold_the_planted_differences():
    change = np.array([1, 1.05, 1, 1, np.exp(-1j * np.radians(3)), 1])
    held, named = 0, 0
    for k in range(20):
        decision = decided(motion(WAVE, 100 + k), motion(WAVE * change, 200 + k))
        by_key = {(d.quantity, d.place): d.difference.ci95 for d in decision.differences}
        truth = {
            ("amplitude", "joint02"): 0.05,
            ("phase_lag", "joint05"): np.radians(3),
            ("phase_lag", "joint06"): -np.radians(3),
            ("amplitude", "joint01"): 0.0,
            ("phase_lag", "joint02"): 0.0,
            ("frequency", "body"): 0.0,
        }
        held += all(by_key[key][0] <= value <= by_key[key][1] for key, value in truth.items())
        named += {n.name for n in decision.named} == {"joint02", "joint05"}
    assert held >= 18
    assert named >= 18


def test_a_joint_late_by_itself_is_named_and_not_the_next_one():
    decision = decided(
        motion(WAVE, 1), motion(WAVE * np.exp(-1j * np.radians(3) * np.eye(6)[2]), 2)
    )
    assert [n.name for n in decision.named] == ["joint03"]


def test_a_joint_that_rests_on_one_side_differs_and_shifts_no_other_lag():
    resting = WAVE * np.array([1, 1, 1, 0, 1, 1])
    decision = decided(motion(WAVE, 3), motion(resting, 4))
    assert [n.name for n in decision.named] == ["joint04"]
    by_key = {(d.quantity, d.place): d for d in decision.differences}
    low, high = by_key["rest_amplitude", "joint04"].difference.ci95
    assert low < -0.4 < high < -0.39
    low, high = by_key["phase_lag", "joint05"].difference.ci95
    assert low < 0 < high


def test_each_plane_has_its_wave():
    robot = load_robot("snake25")
    place = np.arange(25) // 2
    a, b = (
        0.3 * np.exp(-1j * np.where(np.arange(25) % 2, step, 0.4) * place) for step in (0.5, 0.55)
    )
    decision = decided(motion(a, 1, robot=robot), motion(b, 2, robot=robot))
    first, second = dict.fromkeys(joint.plane for joint in robot.joints)
    by_key = {(d.quantity, d.place): d for d in decision.differences}
    assert by_key["wave_number", f"body, {second}"].difference.value == pytest.approx(
        0.05, abs=2e-3
    )
    assert by_key["wave_number", f"body, {first}"].p_holm > 0.05
    late = {d.place for d in decision.differences if d.quantity == "phase_lag" and d.p_holm < 0.05}
    assert late == set(robot.joint_names[3::2])


@pytest.fixture
def write(bag, epoch_ns):
    """Writes a session without commands: 10 s at 50 Hz."""

    def make(name, seed, amplitudes=WAVE, *, omega=OMEGA, noise=NOISE, commands=False):
        rng = np.random.default_rng(seed)
        log, start_s = bag(f"{name}.mcap"), rng.uniform(0, 1)
        for k in range(500):
            t_ns = epoch_ns + k * 20_000_000
            true = np.real(amplitudes * np.exp(1j * omega * (start_s + 0.02 * k))) + 0.1
            q = true + noise * rng.standard_normal(len(true))
            if commands:
                log.write("/joint_commands", t_ns, NAMES, true)
            log.write("/joint_states", t_ns, NAMES, q)
        log.close()
        return log.path

    return make


def compared(a, b, **choices):
    with Session.open(a) as first, Session.open(b) as second:
        return compare_sessions(first, second, Choices(**choices))


def test_a_planted_difference_is_the_answer(write):
    change = np.array([1, 1, 1.05 * np.exp(-1j * np.radians(3)), 1, 1, 1])
    result = compared(write("a", 1), write("b", 2, WAVE * change))
    assert result.verdict == "different"
    assert result.answer.startswith("B differs from A: joint03 most, amplitude +")
    assert "phase lag +" in result.answer
    assert [joint.name for joint in result.named] == ["joint03"]
    assert not result.commanded
    assert result.partial is None
    worst = max(result.waveforms, key=lambda waveform: waveform.rms_rad)
    assert worst.name == "joint03"
    phase = np.array(result.phase_rad)  # 0 at the crest of joint01
    lag = 1.4 + np.radians([0.0, 3.0])
    true = [0.4 * f * np.cos(phase - late) for f, late in zip((1, 1.05), lag, strict=True)]
    off = np.abs(np.array(worst.difference_rad) - (true[1] - true[0]))
    assert np.mean(off <= np.array(worst.half_rad)) > 0.85


def test_one_motion_is_the_same_within_margins(write):
    result = compared(write("a", 5), write("b", 6))
    assert (result.verdict, result.named) == ("same", ())
    assert result.answer == (
        "no difference found; amplitude and phase lag of all 6 joints are equivalent within 2 % "
        "and 1°, the frequency within 5 %"
    )
    with pytest.raises(DataError, match="no periodic motion"):
        compared(write("c", 7), write("still", 8, WAVE * 0))


def test_another_frequency_is_a_difference_and_no_refusal(write):
    result = compared(write("a", 9), write("b", 10, omega=1.1 * OMEGA))
    assert result.verdict == "different"
    assert result.answer.startswith("B differs from A: the body's frequency +10.")


def test_much_noise_leaves_it_open(write):
    result = compared(write("a", 11, noise=0.1), write("b", 12, noise=0.1))
    assert result.verdict == "open"
    assert "% in amplitude and" in result.answer


def test_a_dead_joint_is_named_first(write):
    result = compared(write("a", 13), write("b", 14, WAVE * np.array([1, 1, 1, 0, 1, 1])))
    assert result.verdict == "different"
    assert "joint04" in result.answer.split(",")[0]
    assert (
        result.partial
        == "only 5 joints can be compared by their phase (joint04: no phase in b.mcap)"
    )


@pytest.mark.nightly
def test_groups_and_pairs_by_the_command_line(write, tmp_path, command, report_of):
    change = np.array([1, 1.05, 1, 1, 1, 1])
    a = [write(f"a{k}", 20 + k) for k in range(3)]
    b = [write(f"b{k}", 30 + k, WAVE * change) for k in range(3)]
    out = tmp_path / "page.html"
    text = command("compare", "--a", *a, "--b", *b, "-o", out).out
    assert text.startswith("B differs from A: joint02 most, amplitude +")
    page = out.read_text()
    for shown in (text, page.split("</style>")[1].split('id="method"')[0]):
        assert not re.search(r"\bgain|\bcommands?\b|gait phase", shown)
    paired = report_of("compare", "--a", *a, "--b", *b, "--paired")
    assert paired["named"][0]["name"] == "joint02"
    assert json.dumps(paired, allow_nan=False)
    err = command("compare", "--a", a[0], a[0], "--b", *b, code=1).err
    assert "a copy is not a run of its own" in err


@pytest.mark.nightly
def test_commands_on_one_side_only_are_refused(write):
    a, b = write("a", 40), write("b", 41, commands=True)
    with pytest.raises(DataError, match=r"a\.mcap has no logged commands, b\.mcap has"):
        compared(a, b)
