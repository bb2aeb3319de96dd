"""Cost of a physics step: the twin, against PyBullet's own contacts and motors on the same body.

All step the shipped 25-joint snake at 1 kHz through the same commands, in turn, in one process. The
twin computes ground, servos, what the servos report and the energy ledger itself, with NumPy or
compiled with numba, on PyBullet's dynamics or MuJoCo's; with all sensors, too, which PyBullet's own
way has not: that is capsules on a plane with its anisotropic friction, POSITION_CONTROL motors, and
the links read at every step. Then the same for chains of 12 to 100 joints. Processor time, the
least of several runs: other programs on the machine can only add to it. Look at the load before you
believe an absolute number.

Run: python bench/twin_step.py [--seconds 1] [--runs 5]
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

from measuring import arguments, chain, in_turn, took
from records import compared, versions

from undulog.capture.robot.model import Plane, Robot
from undulog.sim.gait.contract import CONTROL_RATE_HZ, Readings
from undulog.sim.gait.wave import SerpentineGait
from undulog.sim.scenario.scenario import EngineKind, Kernels, Scenario
from undulog.sim.scenario.scenario_file import load_scenario
from undulog.sim.twin.twin import Twin

LENGTHS = (12, 25, 50, 100)
_Way = TypeVar("_Way")
BUILT_IN = "PyBullet contacts + motors"
NUMPY, NUMBA = "twin, NumPy", "twin, numba"


def step_twin(scenario: Scenario, kernels: Kernels) -> float:
    """Return seconds of processor time a step, through the twin."""
    with Twin(scenario, kernels=kernels) as twin:
        samples = twin.samples()
        next(samples)  # the start: what is compiled is there from here on
        used = took(lambda: deque(samples, maxlen=0))
    return used.processor_s / (scenario.duration_s * scenario.physics_rate_hz)


def step_builtin(scenario: Scenario) -> float:
    """Return seconds of processor time a step, with the engine's own contacts and motors."""
    import pybullet  # where its wheels end (Python 3.12), the other benches still run

    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = built_in_body(scenario.robot, client)
        gait = SerpentineGait(scenario.gait, scenario.robot)
        nothing = Readings.nothing(scenario.robot)
        joints = list(range(len(scenario.robot.joints)))
        forces = [joint.servo.stall_torque for joint in scenario.robot.joints]
        steps = scenario.physics_rate_hz // CONTROL_RATE_HZ
        ticks = round(scenario.duration_s * CONTROL_RATE_HZ)
        start = time.process_time()
        for tick in range(ticks):
            command = gait.step(tick / CONTROL_RATE_HZ, nothing).command.tolist()
            motor = {"targetPositions": command, "forces": forces, "physicsClientId": client}
            pybullet.setJointMotorControlArray(body, joints, pybullet.POSITION_CONTROL, **motor)
            for _ in range(steps):
                pybullet.stepSimulation(physicsClientId=client)
                # What a log needs of every step, as the twin reads it too.
                pybullet.getLinkStates(body, joints, 1, 1, physicsClientId=client)
                pybullet.getJointStates(body, joints, physicsClientId=client)
        used = time.process_time() - start
    finally:
        pybullet.disconnect(physicsClientId=client)
    return used / (ticks * steps)


def built_in_body(robot: Robot, client: int) -> int:
    """Return the same chain with capsules that collide, on a plane."""
    import pybullet

    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    pybullet.setTimeStep(1e-3, physicsClientId=client)
    ground = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    pybullet.createMultiBody(0, ground, physicsClientId=client)
    along_x = [0, math.sqrt(0.5), 0, math.sqrt(0.5)]

    def capsule(centre: float, k: int) -> int:
        link = robot.links[k]
        return pybullet.createCollisionShape(
            pybullet.GEOM_CAPSULE,
            radius=link.radius,
            height=link.length,
            collisionFramePosition=[centre, 0, 0],
            collisionFrameOrientation=along_x,
            physicsClientId=client,
        )

    half = [link.length / 2 for link in robot.links]
    count = len(robot.joints)
    axes = {Plane.HORIZONTAL: [0, 0, 1], Plane.VERTICAL: [0, 1, 0]}
    body = pybullet.createMultiBody(
        baseMass=robot.links[0].mass,
        baseCollisionShapeIndex=capsule(0.0, 0),
        basePosition=[0, 0, robot.links[0].radius],
        linkMasses=[link.mass for link in robot.links[1:]],
        linkCollisionShapeIndices=[capsule(-half[k], k) for k in range(1, count + 1)],
        linkVisualShapeIndices=[-1] * count,
        linkPositions=[[-half[0] if k == 0 else -2 * half[k], 0, 0] for k in range(count)],
        linkOrientations=[[0, 0, 0, 1]] * count,
        linkInertialFramePositions=[[-half[k], 0, 0] for k in range(1, count + 1)],
        linkInertialFrameOrientations=[[0, 0, 0, 1]] * count,
        linkParentIndices=list(range(count)),
        linkJointTypes=[pybullet.JOINT_REVOLUTE] * count,
        linkJointAxis=[axes[joint.plane] for joint in robot.joints],
        physicsClientId=client,
    )
    for k in range(-1, count):
        pybullet.changeDynamics(
            body, k, anisotropicFriction=[0.1, 1, 1], lateralFriction=0.5, physicsClientId=client
        )
    return body


def turns(ways: Mapping[_Way, Callable[[], float]], runs: int) -> dict[_Way, list[float]]:
    """Return microseconds a step of each way, turn by turn."""
    costs = in_turn(runs, *ways.values())
    return {name: [1e6 * s for s in step_s] for name, step_s in zip(ways, costs, strict=True)}


def without_sensors(scenario: Scenario) -> Scenario:
    """Return a scenario whose sensors are off."""
    sensing = dataclasses.replace(scenario.sensing, enabled=False)
    return dataclasses.replace(scenario, sensing=sensing)


def main() -> None:
    """Step all in turn, print."""
    options = arguments(__doc__, seconds=1.0, runs=5).parse_args()
    whole = load_scenario("flat").changed(duration_s=options.seconds)
    flat = without_sensors(whole)
    mujoco = dataclasses.replace(flat, engine=EngineKind.MUJOCO)
    step_twin(flat.changed(duration_s=0.05), Kernels.NUMBA)  # compiles, the first time
    costs_us = turns(
        {
            f"{name}{more}": partial(step_twin, scenario, kernels)
            for more, scenario in (("", flat), (", MuJoCo", mujoco), (", all sensors", whole))
            for name, kernels in ((NUMPY, Kernels.NUMPY), (NUMBA, Kernels.NUMBA))
        }
        | {BUILT_IN: partial(step_builtin, flat)},
        options.runs,
    )
    cheapest = {name: min(costs) for name, costs in costs_us.items()}
    theirs = cheapest[BUILT_IN]
    peer = f"{versions('pybullet')}, its contacts and motors"
    for name in (NUMPY, NUMBA):
        what = f"step of 25 joints, {name}"
        compared(what, costs_us[name], costs_us[BUILT_IN], peer, unit="us")
    print(
        f"25 joints at 1 kHz: {1e3 / cheapest[NUMPY]:.1f} x real time with NumPy and "
        f"{1e3 / cheapest[NUMBA]:.1f} x with numba; a step {theirs / cheapest[NUMPY]:.1f} and "
        f"{theirs / cheapest[NUMBA]:.1f} times as cheap as PyBullet's own contacts and motors"
    )
    for name, step_us in cheapest.items():
        print(f"{name:<27} {step_us:7.0f} us a step  {1e3 / step_us:5.1f} x real time")
    print(f"\n{'us a step, by joints':<27}" + "".join(f"{n:>9}" for n in LENGTHS))
    rows: dict[str, list[float]] = {NUMPY: [], NUMBA: [], BUILT_IN: []}
    for n in LENGTHS:
        scenario = dataclasses.replace(
            flat.changed(duration_s=options.seconds / 4), robot=chain(flat.robot, n)
        )
        ways = {
            NUMPY: partial(step_twin, scenario, Kernels.NUMPY),
            NUMBA: partial(step_twin, scenario, Kernels.NUMBA),
            BUILT_IN: partial(step_builtin, scenario),
        }
        for name, costs in turns(ways, options.runs).items():
            rows[name].append(min(costs))
    for name, costs in rows.items():
        print(f"{name:<27}" + "".join(f"{cost:9.0f}" for cost in costs))
    print(f"\nload average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
