"""Every term of the energy ledger on its own, against an exact solution of the same equations.

Two like links in free space, joined by one servo, fold about their common centre: one angle, one
rotor, four first-order equations, and an integral for each flow of energy. scipy solves them to
1e-10; the twin takes its steps. What the ground takes is held to closed forms in
``test_oracles_block.py``.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from support.twin_runs import energies, simulate
from undulog.capture.robot.model import Link, Plane
from undulog.sim import PlaneGait, Serpentine, World, load_scenario
from undulog.sim.physics.ledger import JOINT_TERMS

MASS, LENGTH, INERTIA = 0.5, 0.2, 2e-3
COMMAND, SECONDS = 1.0, 0.6
WEAK = {"stall_torque": 0.25, "gear_stiffness": 10.0, "gear_damping": 0.2}
STRONG = {"stall_torque": 1.5, "gear_stiffness": 20.0, "gear_damping": 0.02}
STICKY = {"stall_torque": 0.5, "torque_constant": 0.3, "coulomb_friction": 0.1}
STICKY |= {"gear_damping": 0.5}


def exact(servo):
    """Flows and stored energies after a step of the command, by name [J]."""
    kt, resistance = servo.torque_constant, servo.resistance_ohm

    def fold_inertia(q):
        # Kinetic energy M q'^2 / 2: the links turn by q/2 each and draw near to each other.
        return INERTIA / 2 + MASS * LENGTH**2 / 8 * math.sin(q / 2) ** 2

    def rates(_, state):
        q, rate, th, om = state[:4]
        voltage = servo.supply_v * np.clip(servo.proportional_gain * (COMMAND - q), -1, 1)
        current = (voltage - kt * om) / resistance
        gear = servo.gear_stiffness * (th - q) + servo.gear_damping * (om - rate)
        coulomb = servo.coulomb_friction * math.tanh(om / 0.05)
        swing = MASS * LENGTH**2 / 32 * math.sin(q) * rate**2
        powers = {
            "mechanical_net": gear * rate,
            "mechanical_plus": max(gear * rate, 0.0),
            "mechanical_abs": abs(gear * rate),
            "electrical_net": voltage * current,
            "electrical_plus": max(voltage * current, 0.0),
            "copper": resistance * current**2,
            "viscous": servo.viscous_friction * om**2,
            "coulomb": coulomb * om,
            "gear_damping": servo.gear_damping * (om - rate) ** 2,
        }
        spin_up = kt * current - servo.viscous_friction * om - coulomb - gear
        motion = (rate, (gear - swing) / fold_inertia(q), om, spin_up / servo.rotor_inertia)
        return [*motion, *(powers[name] for name in JOINT_TERMS)]

    start = np.zeros(4 + len(JOINT_TERMS))
    end = solve_ivp(rates, (0, SECONDS), start, rtol=1e-10, atol=1e-12, max_step=1e-3).y[:, -1]
    q, rate, th, om = end[:4]
    energies = dict(zip(JOINT_TERMS, end[4:], strict=True))
    energies["kinetic"] = fold_inertia(q) * rate**2 / 2
    energies["rotor_kinetic"] = servo.rotor_inertia * om**2 / 2
    energies["gear_spring"] = servo.gear_stiffness * (th - q) ** 2 / 2
    return energies


@pytest.fixture
def folding(make_robot, make_scenario):
    """The twin's energies in the same experiment."""

    def run(rate_hz, **servo):
        robot = make_robot(2, limit=math.pi, **servo)
        link = Link("link", LENGTH, 0.01, MASS, (INERTIA, INERTIA, INERTIA))
        links = tuple(dataclasses.replace(link, name=module.name) for module in robot.links)
        scenario = make_scenario(
            dataclasses.replace(robot, links=links),
            gait=Serpentine({Plane.HORIZONTAL: PlaneGait(0.0, 1.0, 0.0, offset=COMMAND)}, 0.0),
            world=World(gravity=(0.0, 0.0, 0.0), ground=None),
            physics_rate_hz=rate_hz,
            duration_s=SECONDS,
        )
        return robot.joints[0].servo, energies(simulate(scenario)[-1])

    return run


@pytest.mark.parametrize(
    "servo",
    [
        pytest.param(WEAK, id="weak"),
        pytest.param(STRONG, id="strong", marks=pytest.mark.nightly),
        pytest.param(STICKY, id="sticky", marks=pytest.mark.nightly),
    ],
)
def test_every_flow_and_store_of_the_joints_is_exact(folding, servo):
    parameters, whole = folding(4000, **servo)
    _, half = folding(8000, **servo)
    expected = exact(parameters)
    work = expected["mechanical_abs"]
    for name, value in expected.items():
        scale = max(abs(value), work)
        assert half[name] == pytest.approx(value, abs=1e-2 * scale), name
        # The error goes with the step: extrapolated to no step at all, it is gone.
        assert 2 * half[name] - whole[name] == pytest.approx(value, abs=1e-4 * scale), name


def test_a_thrown_robot_changes_speed_into_height(make_robot, make_scenario):
    g, rise, seconds, n = 9.81, 2.0, 0.3, 3
    world = World(gravity=(0.0, 0.0, -g), velocity=(0.5, 0.0, rise), ground=None)
    scenario = make_scenario(
        make_robot(n), amplitude=0.0, world=world, duration_s=seconds, physics_rate_hz=2000
    )
    first, *_, last = simulate(scenario)
    energy = energies(last, first)
    speed = rise - g * seconds
    assert energy["kinetic"] == pytest.approx(n * 0.1 * (speed**2 - rise**2) / 2, rel=1e-9)
    height = rise * seconds - g * seconds**2 / 2 - g * seconds * 5e-4 / 2  # half a step early
    assert energy["potential"] == pytest.approx(n * 0.1 * g * height, rel=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name", ["flat", "weak-servo-pi3", "snake13-vertical-pi3", "sidewinding", "rolling", "twist"]
)
def test_shipped_scenarios_close_their_ledger(name):
    samples = simulate(load_scenario(name).changed(duration_s=8.0))
    flow = energies(samples[-1], samples[400])
    assert abs(flow["mechanical_residual"]) < 1e-3 * flow["mechanical_abs"]
    assert abs(flow["electrical_residual"]) < 1e-3 * flow["mechanical_abs"]
