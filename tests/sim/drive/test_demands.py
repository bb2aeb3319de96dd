"""Demands on joints, added up by hand, and the gate as a gait of the twin."""

from types import SimpleNamespace

import numpy as np
import pytest

from support.twin_chains import chain
from undulog.capture.robot.description import parse_robot
from undulog.sim.drive.dry_run_gait import DemandTally, GatedGait, NotedGait
from undulog.sim.drive.gate import Gate
from undulog.sim.drive.limits import GateLimits
from undulog.sim.drive.outcome import GatePhase
from undulog.sim.gait.contract import GaitTick, Readings
from undulog.sim.physics.ledger import JOINT_TERMS
from undulog.sim.physics.sensing import JointSample

ROBOT = parse_robot(chain(3), "chain.toml", {})
COUNT = len(ROBOT.joints)
NAN = np.nan


def limits(**more):
    names = ROBOT.joint_names
    values = {
        "joint_names": names, "lower": ROBOT.limits()[0], "upper": ROBOT.limits()[1],
        "rate": np.full(COUNT, 4.0), "ramp_rate": np.full(COUNT, 1.0),
        "tracking_error": np.full(COUNT, 0.3), "current": np.full(COUNT, 1.4),
        "temperature": np.full(COUNT, NAN), "voltage": np.full(COUNT, NAN),
        "reply_timeout_s": 0.25, "late_s": 0.2, "fault_after_s": 0.3, "on_fault": "ramp-down",
    }  # fmt: skip
    return GateLimits(**(values | more))


def tally(**more):
    return DemandTally(ROBOT, limits(**more))


def row(*values):
    return np.array([*values, *[0.0] * (COUNT - len(values))])


def sample(effort, current):
    values = dict.fromkeys(JointSample._fields, np.zeros(COUNT))
    return JointSample(**(values | {"effort": row(*effort), "current": row(*current)}))


def test_nothing_is_known_before_the_first_tick():
    for joint, given in zip(tally().joints(), ROBOT.joints, strict=True):
        assert (joint.name, joint.lower, joint.upper) == (given.name, given.lower, given.upper)
        assert (joint.least, joint.greatest) == (np.inf, -np.inf)
        assert (joint.rate, joint.acceleration, joint.clamped) == (0.0, 0.0, 0.0)
        unknown = (joint.torque_peak, joint.torque_rms, joint.current_peak, joint.tracking_error)
        assert np.isnan(unknown).all()
        assert (joint.energy_net_j, joint.energy_abs_j, joint.energy_el_j) == (0.0, 0.0, 0.0)
        assert joint.stall_torque == given.servo.stall_torque
        assert (joint.max_rate, joint.max_current, joint.max_tracking_error) == (4.0, 1.4, 0.3)


def test_limits_that_are_infinite_are_none():
    endless = np.full(COUNT, np.inf)
    joint = tally(rate=endless, current=endless, tracking_error=endless).joints()[0]
    assert np.isnan((joint.max_rate, joint.max_current, joint.max_tracking_error)).all()


def test_rates_and_accelerations_are_differences_of_commands():
    demands = tally()
    for first, second in ((0.1, 0.0), (0.13, 0.0), (0.14, -0.02), (0.05, -0.02)):
        demands.command(row(first, second), np.array([first > 0.12, *[False] * (COUNT - 1)]))
    first_joint, second_joint, *_ = demands.joints()
    assert (first_joint.least, first_joint.greatest) == (0.05, 0.14)
    assert first_joint.rate == pytest.approx(9.0)  # 0.09 rad in 10 ms
    assert first_joint.acceleration == pytest.approx(1000.0)  # from 0.01 to -0.09 rad in a tick
    assert first_joint.clamped == 0.5
    assert (second_joint.least, second_joint.greatest, second_joint.clamped) == (-0.02, 0.0, 0.0)
    assert (second_joint.rate, second_joint.acceleration) == pytest.approx((2.0, 200.0))
    begun = tally()  # it rests in the first pose before
    begun.command(row(0.3), np.zeros(COUNT, dtype=bool))
    assert (begun.joints()[0].rate, begun.joints()[0].acceleration) == (0.0, 0.0)
    begun.command(row(0.32), np.ones(COUNT, dtype=bool))
    joint = begun.joints()[0]
    assert (joint.rate, joint.acceleration, joint.clamped) == pytest.approx((2.0, 200.0, 0.5))


def test_torques_and_currents_are_those_that_servos_report():
    demands = tally()
    demands.receive([sample((0.3, -0.1), (0.2, -0.9)), SimpleNamespace(effort=9.0)])
    demands.receive([])
    demands.receive([sample((-0.4, 0.1), (0.1, 0.3)), sample((0.0, 0.1), (0.0, 0.0))])
    first_joint, second_joint, *_ = demands.joints()
    assert (first_joint.torque_peak, second_joint.torque_peak) == (0.4, 0.1)
    assert first_joint.torque_rms == pytest.approx(np.sqrt(np.mean([0.3**2, 0.4**2, 0.0])))
    assert second_joint.torque_rms == pytest.approx(0.1)
    assert (first_joint.current_peak, second_joint.current_peak) == (0.2, 0.9)


def test_the_tracking_error_is_the_largest_that_is_known():
    demands = tally()
    for error in (row(0.1, NAN), row(-0.2, NAN), row(NAN, NAN)):
        demands.measured(error)
    first_joint, second_joint, *_ = demands.joints()
    assert first_joint.tracking_error == 0.2
    assert np.isnan(second_joint.tracking_error)


def test_energies_count_from_the_first_one():
    demands = tally()
    for k in (1, 2, 5):
        flows = k * np.arange(1.0, len(JOINT_TERMS) + 1)[:, None] * np.arange(1.0, COUNT + 1)
        demands.energy(flows)
    for number, joint in enumerate(demands.joints(), start=1):
        for name, value in (
            ("mechanical_net", joint.energy_net_j),
            ("mechanical_abs", joint.energy_abs_j),
            ("electrical_net", joint.energy_el_j),
        ):
            assert value == 4.0 * number * (1 + JOINT_TERMS.index(name))


# -- the gate as a gait -------------------------------------------------------------------------


class Steps:
    """A gait of given first angles, cut in some ticks."""

    names = ("horizontal.A",)

    def __init__(self, *angles, cut=()):
        self.angles, self.cut, self.asked = list(angles), cut, 0

    def step(self, time_s, readings):
        del readings
        assert time_s == pytest.approx(self.asked / 100)
        self.asked += 1
        angle = self.angles[min(self.asked, len(self.angles)) - 1]
        named = ("joint02", "joint01") if self.asked in self.cut else ()
        return GaitTick(row(angle), np.array([float(self.asked)]), "walk", named)


def gated(gait, duration_s=1.0, **more):
    """The gate of a gait, whose robot is where it was commanded to be: a function of ticks."""
    inner, given = NotedGait(gait, ROBOT), limits(**more)
    gate = Gate(inner, given, duration_s=duration_s, place="the twin")
    gated_gait = GatedGait(inner, gate, ROBOT, given)
    gated_gait.twin = SimpleNamespace(sensed=[])
    angle = [np.zeros(COUNT)]

    def run(ticks, current=0.0, behind=0.0):
        ran = []
        for _ in range(ticks):
            gated_gait.twin.sensed = [sample((0.1,), (current,))]
            ran.append(gated_gait.step(99.0, Readings(angle[0] - row(behind), np.zeros(COUNT))))
            angle[0] = ran[-1].command
        return ran

    return inner, gate, gated_gait, run


def test_before_the_gait_begins_the_gate_moves_and_says_its_phase():
    inner, gate, gated_gait, run = gated(Steps(0.099))
    ticks = run(14)  # 1.5 x 0.099 rad at 1 rad/s are 149 ms
    assert {tick.mode for tick in ticks} == {"approach"}
    assert all(np.isnan(tick.values).all() and tick.clamped == () for tick in ticks)
    assert gated_gait.tally.joints()[0].greatest == -np.inf
    np.testing.assert_array_equal(inner.first, row(0.099))
    (begun,) = run(1)
    assert (begun.mode, begun.values.tolist(), gate.phase) == ("walk", [1.0], GatePhase.RUN)
    np.testing.assert_allclose(begun.command, row(0.099))
    texts = [remark.text for remark in gated_gait.fresh_remarks()]
    assert [text.split(",")[0] for text in texts] == [
        "gate: reading the pose", "gate: approach", "gate: run",
    ]  # fmt: skip
    assert list(gated_gait.fresh_remarks()) == []


def test_what_the_gait_cuts_is_named_once_in_order():
    inner, _, _, run = gated(Steps(0.0, cut=(2, 4)))
    assert np.isnan(inner.first).all()
    run(1)
    assert inner.cut == ()
    ticks = run(4)
    assert inner.cut == ("joint02", "joint01")
    assert [tick.clamped for tick in ticks] == [("joint02", "joint01"), (), inner.cut, ()]


def test_demands_are_before_the_gate_and_commands_behind_it():
    _, gate, gated_gait, run = gated(Steps(0.0, 0.1, 0.1, 0.1, 0.1), duration_s=0.05)
    ticks = run(6)
    np.testing.assert_allclose(
        [tick.command[0] for tick in ticks], [0.0, 0.04, 0.08, 0.1, 0.1, 0.1]
    )
    joint = gated_gait.tally.joints()[0]
    assert (joint.greatest, joint.rate) == pytest.approx((0.1, 10.0))
    assert joint.clamped == pytest.approx(2 / 6)
    assert gate.done
    assert [remark.level for remark in gated_gait.remarks].count("warn") == 1
    (after,) = run(1)
    assert (after.mode, after.values.tolist()) == ("done", [6.0])
    assert joint.torque_peak == pytest.approx(0.1)
    np.testing.assert_allclose(after.command, row(0.1))


def test_only_what_is_measured_while_it_runs_counts():
    _, _, gated_gait, run = gated(Steps(0.099), tracking_error=np.full(COUNT, 9.0))
    run(1)
    run(13, behind=0.05)
    gated_gait.book(SimpleNamespace(joint_energy=np.full((len(JOINT_TERMS), COUNT), 100.0)))
    run(1)
    assert np.isnan(gated_gait.tally.joints()[0].tracking_error)
    gated_gait.book(SimpleNamespace(joint_energy=np.full((len(JOINT_TERMS), COUNT), 10.0)))
    run(2, behind=0.02)
    gated_gait.book(SimpleNamespace(joint_energy=np.full((len(JOINT_TERMS), COUNT), 12.5)))
    joint = gated_gait.tally.joints()[0]
    assert joint.tracking_error == pytest.approx(0.02)
    assert joint.energy_net_j == 2.5


def test_the_gate_sees_the_currents_of_the_twin():
    _, gate, gated_gait, run = gated(Steps(0.0), duration_s=60.0)
    run(2, current=1.5)
    assert any("draws more than 1.4 A" in remark.text for remark in gated_gait.remarks)
    run(40, current=1.5)
    assert gate.outcome.fault.kind == "current"
    assert gate.outcome.fault.value == 1.5
