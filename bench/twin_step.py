"""Cost of a physics step: the twin, against PyBullet's own contacts and motors on the same body.

Both step the shipped 25-joint snake at 1 kHz through the same commands, in turn, in one process.
The twin computes ground, servos and the energy ledger itself; PyBullet's way has capsules on a
plane with its anisotropic friction, and POSITION_CONTROL motors. Processor time, median of runs.

Run: python bench/twin_step.py [--seconds 2] [--runs 5]
"""

from __future__ import annotations

import argparse
import math
import statistics
import time

import pybullet

from capture.robot import Plane, Robot
from sim.gait import SerpentineGait
from sim.readings import Readings
from sim.scenario import CONTROL_RATE_HZ, Scenario
from sim.scenario_file import load_scenario
from sim.twin import Twin


def step_twin(scenario: Scenario) -> float:
    """Seconds of processor time a step, through the twin."""
    with Twin(scenario) as twin:
        start = time.process_time()
        for _ in twin.samples():
            pass
        used = time.process_time() - start
    return used / (scenario.duration_s * scenario.physics_rate_hz)


def step_builtin(scenario: Scenario) -> float:
    """Seconds of processor time a step, with the engine's own contacts and motors."""
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
            pybullet.setJointMotorControlArray(
                body,
                joints,
                pybullet.POSITION_CONTROL,
                targetPositions=command,
                forces=forces,
                physicsClientId=client,
            )
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
    """The same chain with capsules that collide, on a plane."""
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


def main() -> None:
    """Step both in turn, print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    scenario = load_scenario("flat").changed(duration_s=options.seconds)
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(options.runs):
        ours.append(step_twin(scenario))
        theirs.append(step_builtin(scenario))
    ratio = statistics.median(theirs) / statistics.median(ours)
    print(f"{ratio:.1f} times as cheap a step as PyBullet's own contacts and motors")
    for name, seconds in (("undulog twin", ours), ("PyBullet contacts + motors", theirs)):
        each = 1e6 * statistics.median(seconds)
        print(
            f"{name:<27} {each:7.0f} us a step (min {1e6 * min(seconds):.0f}, "
            f"max {1e6 * max(seconds):.0f})  real-time factor {1e3 / each:.1f} at 1 kHz"
        )


if __name__ == "__main__":
    main()
