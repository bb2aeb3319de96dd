"""Joints that do not follow: signals in closed form, one fault each, and the kinds that fit."""

import numpy as np
import pytest

from undulog.capture.judgement.fault import KINDS
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples

RATE, LENGTH, OMEGA, GAIN, LAG, NOISE = 100.0, 15.0, 2 * np.pi * 0.83, 0.95, np.radians(10), 4e-3
BROKEN = 3


class Chain:
    """Nine identical joints whose signals a test may change before they are judged."""

    def __init__(self, joints=9, seed=1, step=-np.pi / 3):
        self.t = np.arange(int(RATE * LENGTH)) / RATE
        phase = OMEGA * self.t + step * np.arange(joints)[:, None]
        self.rng = np.random.default_rng(seed)
        self.command = 0.4 * np.sin(phase)
        self.true = GAIN * 0.4 * np.sin(phase - LAG)
        self.position = self.true + self.rng.normal(0, NOISE, self.true.shape)
        self.velocity = GAIN * 0.4 * OMEGA * np.cos(phase - LAG)
        self.effort = 5 * (self.command - self.true)
        self.second = self.true.copy()
        self.channels = set()

    def judged(self, *channels, outside=()):
        judgement = judge(self.motions(*channels, outside=outside))
        return {fault.joint: fault for fault in judgement.faults}

    def motions(self, *channels, outside=()):
        def samples(values, quantity=None):
            return Samples(self.t, values) if quantity is None or quantity in channels else None

        return [
            RecordedJoint(
                f"j{k + 1}",
                Samples(self.t, self.command[k]),
                Samples(self.t, self.position[k]),
                velocity=samples(self.velocity[k], "velocity"),
                effort=samples(self.effort[k], "effort"),
                reference=samples(self.second[k], "second"),
                outside_loop=frozenset(outside),
            )
            for k in range(len(self.command))
        ]


@pytest.fixture
def chain():
    return Chain()


def jam(chain, at_s=7.4):
    later = chain.t > at_s
    chain.position[BROKEN, later] = chain.position[BROKEN, ~later][-1]
    chain.velocity[BROKEN, later] = 0.0
    chain.second[BROKEN, later] = chain.true[BROKEN, ~later][-1]
    chain.effort[BROKEN] = np.where(
        later, 5 * (chain.command[BROKEN] - chain.position[BROKEN]), chain.effort[BROKEN]
    )


@pytest.mark.parametrize("joints", [1, 2, 4, 9, pytest.param(40, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("step", [-np.pi / 3, 0.0])
@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 5), marks=pytest.mark.nightly)])
def test_sound_joints_are_not_named(joints, step, seeds):
    for seed in seeds:
        assert Chain(joints, seed, step).judged("velocity", "effort", "second") == {}


def coarse(seed, encoder=2 * np.pi / 4096):
    """26 joints that move by one or two steps of a noisy encoder between two samples."""
    chain = Chain(26, seed)
    rate = np.where(np.arange(26) % 2, 1.0, 1.8) * encoder / np.max(np.abs(np.diff(chain.true)))
    chain.command, chain.true = rate[:, None] * chain.command, rate[:, None] * chain.true
    noisy = chain.true + chain.rng.normal(0, 1.1 * encoder, chain.true.shape)
    chain.position = encoder * np.round(noisy / encoder)
    return chain


def test_a_vibration_near_the_limit_of_the_sampling_is_no_noise(chain):
    """Its turning points lie far from the running median of a few samples."""
    burst = np.exp(-(((chain.t[:, None] - [3.0, 6.0, 9.0, 12.0]) / 0.15) ** 2)).sum(1)
    chain.position[BROKEN] += 0.6 * burst * np.sin(2 * np.pi * 9.3 * chain.t)
    assert "noisy_sensor" not in {kind for fault in chain.judged().values() for kind in fault.kinds}


@pytest.mark.nightly
@pytest.mark.parametrize("lost", [0, 40])
def test_a_gait_of_fewer_than_three_samples_a_cycle_accuses_nobody(chain, lost):
    phase = 2.5 * np.arange(chain.t.size) + np.arange(9)[:, None]
    chain.command, chain.position = 0.35 * np.sin(phase), 0.35 * np.sin(phase + 0.5)
    for values in (chain.command, chain.position):
        values[:, 100 : 100 + lost] = values[:, [100]]
    assert chain.judged() == {}


@pytest.mark.slow
def test_all_joints_inverted_are_not_named_wrongly():
    chain = Chain(25, step=-np.pi / 6)
    chain.position *= -1
    judgement = judge(chain.motions())
    assert {fault.kinds for fault in judgement.faults} == {("inverted", "inverted_sensor")}
    assert (len(judgement.faults), judgement.naming) == (25, "")


def test_a_joint_that_is_dragged_may_be_dead_or_scaled(chain):
    chain.position[BROKEN] = np.radians(chain.position[BROKEN])
    assert set(chain.judged()["j4"].kinds) >= {"dead", "scaled_sensor"}


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 20), marks=pytest.mark.nightly)])
def test_a_noisy_coarse_encoder_repeats_values_by_chance(seeds):
    for seed in seeds:
        assert coarse(seed).judged() == {}


def test_a_jam_is_named_with_its_time_and_all_kinds_that_fit(chain):
    jam(chain)
    faults = chain.judged("velocity")
    assert list(faults) == ["j4"]
    assert faults["j4"].since_s == pytest.approx(7.4, abs=0.3)
    assert faults["j4"].until_s is None
    assert {"jammed", "frozen_sensor"} <= set(faults["j4"].kinds)
    assert faults["j4"].about == "mechanics or sensor"


@pytest.mark.parametrize(
    ("channel", "excluded"), [("effort", {"frozen_sensor", "dead"}), ("second", {"frozen_sensor"})]
)
def test_effort_or_a_second_sensor_exclude_kinds_of_a_jam(chain, channel, excluded):
    jam(chain)
    kinds = set(chain.judged(channel, outside=["effort"])["j4"].kinds)
    assert "jammed" in kinds
    assert not kinds & excluded


@pytest.mark.parametrize("channel", ["velocity", "effort", "second"])
def test_a_frozen_sensor_is_decided_by_any_other_channel(chain, channel):
    later = chain.t > 7.4
    chain.position[BROKEN, later] = chain.position[BROKEN, ~later][-1]
    fault = chain.judged(channel, outside=["velocity", "effort"])["j4"]
    assert fault.kinds == ("frozen_sensor",)


def test_effort_of_the_servos_own_loop_tells_no_frozen_sensor_from_a_jam(chain):
    jam(chain)
    assert set(chain.judged("effort")["j4"].kinds) == {"jammed", "frozen_sensor"}


@pytest.mark.slow
def test_a_dead_joint_has_no_effort(chain):
    chain.position[BROKEN] = chain.rng.normal(0, NOISE, chain.t.size)
    chain.velocity[BROKEN] = chain.effort[BROKEN] = 0.0
    fault = chain.judged("velocity")["j4"]
    assert fault.since_s is None
    assert {"dead", "jammed"} <= set(fault.kinds)
    assert "frozen_sensor" not in fault.kinds  # new noise in each sample
    assert chain.judged("effort")["j4"].kinds == ("dead",)


@pytest.mark.slow
def test_an_inverted_joint(chain):
    chain.position[BROKEN] *= -1
    assert chain.judged()["j4"].kinds == ("inverted", "inverted_sensor")
    assert chain.judged("second")["j4"].kinds == ("inverted_sensor",)
    assert chain.judged("velocity")["j4"].kinds == ("inverted_sensor",)
    chain.second[BROKEN] *= -1
    assert chain.judged("second")["j4"].kinds == ("inverted",)


def test_holds_again_and_again_are_intermittent(chain):
    for start in np.arange(1.0, 14.0, 2.5):
        held = (chain.t > start) & (chain.t < start + 0.5)
        chain.position[BROKEN, held] = chain.position[BROKEN, held][0]
    fault = chain.judged()["j4"]
    assert fault.kinds[0] == "intermittent"
    assert 0.02 < fault.share < 0.4


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda p, t, rng: np.degrees(p), "scaled_sensor"),
        (lambda p, t, rng: np.repeat(p[::3], 3)[: t.size], "stale_sensor"),
    ],
)
def test_faults_of_a_sensor(chain, change, kind):
    chain.position[BROKEN] = change(chain.position[BROKEN], chain.t, chain.rng)
    faults = chain.judged()
    assert list(faults) == ["j4"]
    assert kind in faults["j4"].kinds


@pytest.mark.parametrize(
    ("change", "quantity", "size"),
    [
        (lambda p, t, rng: p + 0.15 * (t > 8), "offset", 0.15),
        (lambda p, t, rng: p * np.where(t > 8, 0.7, 1.0), "gain", -0.3),
        (lambda p, t, rng: np.where(t > 8, np.interp(t - 0.05, t, p), p), "lag", 0.05),
    ],
)
def test_a_change_is_no_fault_and_has_its_time(chain, change, quantity, size):
    chain.position[BROKEN] = change(chain.position[BROKEN], chain.t, chain.rng)
    judgement = judge(chain.motions())
    assert judgement.faults == ()
    (stated,) = judgement.changes
    assert (stated.joint, stated.quantity, stated.until_s) == ("j4", quantity, None)
    assert stated.change == pytest.approx(size, rel=0.1)
    assert stated.onset_s[0] < 8 < stated.onset_s[1]


def test_a_noisier_sensor_has_its_time(chain):
    chain.position[BROKEN] += 0.05 * chain.rng.normal(size=chain.t.size) * (chain.t > 8)
    (stated,) = judge(chain.motions()).changes
    assert (stated.joint, stated.quantity) == ("j4", "noise")
    assert stated.onset_s[0] < 8 < stated.onset_s[1]


def test_a_vibration_is_motion_besides_the_command(chain):
    chain.position[BROKEN] += 0.1 * np.sin(2 * np.pi * 6.1 * chain.t)
    (line,) = judge(chain.motions()).extra
    assert line.joint == "j4"
    assert line.frequency_hz == pytest.approx(6.1, abs=0.1)
    assert line.amplitude_rad == pytest.approx(0.1, rel=0.1)


def test_a_line_at_half_the_pace_of_few_cycles_is_told_from_a_drift(chain):
    chain.position[BROKEN] += 0.05 * np.sin(OMEGA / 2 * chain.t)
    (line,) = judge(chain.motions()).extra
    assert line.joint == "j4"
    assert line.frequency_hz == pytest.approx(OMEGA / 4 / np.pi, abs=0.02)
    assert line.amplitude_rad == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("noisy", [False, True])
def test_a_vibration_larger_than_the_motion_is_no_noise(chain, noisy):
    chain.command *= 0.1
    chain.position *= 0.1
    line = 0.06 * np.sin(2 * np.pi * 6.1 * chain.t)
    chain.position[BROKEN] += chain.rng.permutation(line) if noisy else line
    judgement = judge(chain.motions())
    assert [fault.joint for fault in judgement.faults] == ["j4"] * noisy
    assert [line.joint for line in judgement.extra] == ["j4"] * (not noisy)


def test_a_joint_that_is_dead_at_another_angle_does_not_vibrate():
    chain = Chain()
    chain.command *= 0.08
    chain.position *= 0.08
    later = chain.t > 8
    chain.position[BROKEN, later] = 0.2 + chain.rng.normal(0, 0.01, later.sum())
    (fault,) = judge(chain.motions()).faults
    assert fault.joint == "j4"
    assert "dead" in fault.kinds


@pytest.mark.parametrize("cycles", [7.4, 7.9])
def test_half_the_pace_of_seven_cycles_is_no_drift_where_like_joints_lack_it(chain, cycles):
    chain.position[BROKEN] += 0.05 * np.sin(OMEGA / 2 * chain.t)
    count = int(cycles * 2 * np.pi / OMEGA * RATE)
    chain.t = chain.t[:count]
    chain.command, chain.position = chain.command[:, :count], chain.position[:, :count]
    (line,) = judge(chain.motions()).extra
    assert (line.joint, line.frequency_hz) == ("j4", pytest.approx(OMEGA / 4 / np.pi, abs=0.03))


def test_a_vibration_of_a_part_of_the_record_has_its_own_amplitude(chain):
    chain.position[BROKEN] += 0.02 * np.sin(2 * np.pi * 5.3 * chain.t) * (chain.t < 9)
    judgement = judge(chain.motions())
    stated = [finding.joint for finding in (*judgement.extra, *judgement.changes)]
    assert stated
    assert {*stated} == {"j4"}
    for line in judgement.extra:
        assert line.amplitude_rad == pytest.approx(0.02, rel=0.1)


def test_more_noise_tells_less_of_gain_and_lag(chain):
    later = chain.t > 7
    chain.position[BROKEN] += 0.04 * chain.rng.normal(size=chain.t.size) * later
    (stated,) = judge(chain.motions()).changes
    assert (stated.joint, stated.quantity) == ("j4", "noise")


def test_a_zero_that_drifts_is_no_gain(chain):
    chain.position[BROKEN] += 0.12 * (chain.t / chain.t[-1] - 0.5)
    judgement = judge(chain.motions())
    assert judgement.apart == judgement.faults == ()
    (change,) = judgement.changes
    assert (change.joint, change.quantity) == ("j4", "drift")
    assert change.change == pytest.approx(0.12, rel=0.1)


@pytest.mark.slow
def test_two_kinds_of_servos_are_no_reason_to_doubt_the_names():
    chain = Chain(15, step=-2 * np.pi / 15)
    rear = np.arange(15) > 6
    late = GAIN * 0.4 * np.sin(OMEGA * chain.t - 2 * np.pi / 15 * np.arange(15)[:, None] - 3 * LAG)
    chain.position[rear] = 0.95 * late[rear]
    judgement = judge(chain.motions())
    assert (judgement.naming, judgement.faults) == ("", ())


def test_swapped_cables_name_both(chain):
    chain.position[[3, 4]] = chain.position[[4, 3]]
    faults = chain.judged()
    assert {name: fault.kinds for name, fault in faults.items()} == {
        "j4": ("swapped",),
        "j5": ("swapped",),
    }


def test_what_all_joints_do_together_is_no_joint_s_fault(chain):
    stopped = (chain.t > 6) & (chain.t < 8)
    first = int(np.argmax(stopped))
    chain.position[:, stopped] = chain.position[:, first : first + 1]
    faults = chain.judged()
    assert not faults or len(faults) == 9


def test_a_pause_of_the_bus_in_which_a_driver_repeats_accuses_nobody(chain):
    for first in (300, 700, 1100):
        chain.position[:, first : first + 80] = chain.position[:, [first - 1]]
    judgement = judge(chain.motions())
    assert (judgement.faults, judgement.changes) == ((), ())


def test_joints_that_all_repeat_one_value_throughout_do_not_follow(chain):
    chain.position[:] = 0.1
    assert len(chain.judged()) == 9


def test_joints_that_are_late_by_half_a_cycle_are_not_said_to_be_inverted():
    chain = Chain()
    fast = 2 * np.pi * 1.9
    phase = fast * chain.t - np.arange(9)[:, None] / 2
    chain.command, chain.position = 0.3 * np.sin(phase), 0.27 * np.sin(phase - 0.28 * fast)
    judgement = judge(chain.motions())
    assert judgement.faults == ()
    assert judgement.naming.startswith("all joints move against their commands, or lag by 0.28 s")


def test_a_zero_that_drifts_is_a_drift(chain):
    chain.position[BROKEN] += np.linspace(0, np.radians(4), chain.t.size)
    (change,) = judge(chain.motions()).changes
    assert (change.joint, change.quantity) == ("j4", "drift")
    assert change.change == pytest.approx(np.radians(4), rel=0.15)


def test_every_kind_says_where_it_lies():
    assert {about for about, _ in KINDS.values()} == {"mechanics", "wiring", "sensor", "record"}


def test_a_slow_gait_rests_at_none_of_its_turns():
    t = np.arange(0, 60, 0.01)
    phase = 2 * np.pi * t / 7.5 - 0.5 * np.arange(6)[:, None]
    motions = [
        RecordedJoint(f"j{k}", Samples(t, 0.6 * np.sin(x)), Samples(t, 0.5 * np.sin(x - 0.1)))
        for k, x in enumerate(phase)
    ]
    assert judge(motions).rests == ()


def test_a_tooth_that_slips_is_seen_in_a_small_motion():
    chain = Chain()
    chain.command *= 0.05
    chain.position *= 0.05
    chain.position[BROKEN] += 0.3 * (chain.t > 9)
    (stated,) = judge(chain.motions()).changes
    assert (stated.joint, stated.quantity) == ("j4", "offset")
    assert stated.change == pytest.approx(0.3, rel=0.02)
