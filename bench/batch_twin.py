"""Runs of the twin on one core: a batch of them, against one after the other and other simulators.

All step the same chain at 1 kHz, with the gait of the scenario weak-servo-pi3. Compared:

- the batch, float64 and float32, with 16 and 64 runs;
- single runs of the twin with compiled laws, on MuJoCo and on PyBullet (control, samples and the
  energy ledger included, sensors off);
- PyBullet's own contacts and position motors, which is other physics;
- MuJoCo's rollout, its stepper of many worlds in C, on one thread. It takes controls and no forces,
  so it can't run the twin's laws: it is given the body alone (no ground, no motors), and the body
  with MuJoCo's own contacts (capsules, elliptic cones) and position actuators.

Processor time, the least of several rounds in turn. The batch must make 3 times the runs of single
ones on MuJoCo at 25 joints, with equal outputs.

Run: python bench/batch_twin.py [--seconds 2] [--rounds 3]
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np
from measuring import Took, arguments, chain, took
from mujoco import rollout
from records import compared, verdict, versions
from twin_step import step_builtin, step_twin, turns, without_sensors

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane
from undulog.sim import Scenario, load_scenario, run_batch
from undulog.sim.physics.engine import BodyStart
from undulog.sim.physics.mujoco import body_spec
from undulog.sim.scenario.scenario import EngineKind, Kernels
from undulog.sim.twin.twin import Twin

PEER = versions("mujoco")
LENGTHS = (5, 25, 50)
WORLDS = (16, 64)
ON_MUJOCO, ON_BULLET = "twin, numba + MuJoCo", "twin, numba + PyBullet"
BUILT_IN = "PyBullet contacts + motors"


def servos_of(scenario: Scenario, worlds: int) -> list[Scenario]:
    """Return the scenario with supplies from 5 V to 6 V."""
    runs: list[Scenario] = []
    for k in range(worlds):
        joints = tuple(
            dataclasses.replace(
                joint, servo=dataclasses.replace(joint.servo, supply_v=5 + k / worlds)
            )
            for joint in scenario.robot.joints
        )
        robot = dataclasses.replace(scenario.robot, joints=joints)
        runs.append(dataclasses.replace(scenario, robot=robot))
    return runs


def batch_took(
    scenario: Scenario, worlds: int, dtype: type[np.floating], device: str = "cpu"
) -> Took:
    """Return the cost of a batch; the servos differ from run to run."""
    runs, done = servos_of(scenario, worlds), []
    used = took(lambda: done.extend(run_batch(runs, dtype=dtype, device=device)))
    assert all(output.error is None for output in done), [str(output.error) for output in done]
    return used


def step_batch(scenario: Scenario, worlds: int, dtype: type[np.floating]) -> float:
    """Return seconds of processor time a step of one world."""
    steps = worlds * scenario.duration_s * scenario.physics_rate_hz
    return batch_took(scenario, worlds, dtype).processor_s / steps


def step_rollout(scenario: Scenario, worlds: int, *, contacts: bool) -> float:
    """Return seconds of processor time a step of one world, by MuJoCo's rollout on one thread."""
    robot = scenario.robot
    gravity = scenario.world.gravity if contacts else (0.0, 0.0, 0.0)
    start = BodyStart(gravity, robot.links[0].radius, 0.0, (0.0, 0.0, 0.0), 1e-3)
    spec = body_spec(robot, start.gravity, start.dt)
    if contacts:
        add_contacts(spec, scenario)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = start.height
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.empty(size)
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    steps = round(scenario.duration_s * 1000)
    controls = np.zeros((worlds, steps, model.nu))
    start = np.tile(state, (worlds, 1))
    used = took(partial(rollout.rollout, model, data, start, controls, nstep=steps))
    return used.processor_s / (worlds * steps)


def add_contacts(spec: mujoco.MjSpec, scenario: Scenario) -> None:
    """Add a plane, a capsule a link and a position actuator a joint, all MuJoCo's own."""
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    plane, capsule = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE
    spec.worldbody.add_geom(type=plane, size=(0, 0, 1), contype=1, conaffinity=2)
    for link, body in zip(scenario.robot.links, spec.bodies[1:], strict=True):
        half = link.length / 2
        ends = (-half, 0.0, 0.0, half, 0.0, 0.0)
        body.add_geom(type=capsule, fromto=ends, size=(link.radius, 0, 0), contype=2, conaffinity=1)
    for k, joint in enumerate(spec.joints[1:]):
        joint.name = f"joint{k}"
        actuator = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=2.0)


def angles_on_mujoco(scenario: Scenario) -> FloatArray:
    """Return the joint angles of a single run on MuJoCo."""
    single = dataclasses.replace(scenario, engine=EngineKind.MUJOCO)
    with Twin(single, kernels=Kernels.NUMBA) as twin:
        return np.array([sample.step.body.angle for sample in twin.samples()])


def response(angle: FloatArray, command: FloatArray, frequency_hz: float) -> FloatArray:
    """Return gains and lags [rad] over the last cycle, by projection on the gait's harmonic."""
    count = round(100 / frequency_hz)
    wave = np.exp(-2j * np.pi * np.arange(count) / count)
    ratio = (wave @ angle[-count:]) / (wave @ command[-count:])
    return np.array([np.abs(ratio), -np.angle(ratio)])


def agreement(scenario: Scenario) -> bool:
    """Print how far the batch's outputs are from single runs on MuJoCo; return whether too far."""
    whole = scenario.changed(duration_s=5.0)
    expected = angles_on_mujoco(whole)
    (double,), (single,) = run_batch([whole]), run_batch([whole], dtype=np.float32)
    yaw = whole.robot.joint_indices(Plane.HORIZONTAL)
    wave = whole.gait.planes[Plane.HORIZONTAL]
    responses = [
        response(angle[:, yaw], double.command[:, yaw], wave.frequency_hz)
        for angle in (expected, double.angle, single.angle)
    ]
    apart = np.abs(double.angle - expected)[:101].max() / wave.amplitude
    double_error, single_error = (
        float(np.abs(other - responses[0]).max()) for other in responses[1:]
    )
    good = [
        verdict(f"batch: {what}", value, bar, "", peer=PEER)
        for what, value, bar in (
            ("joint angles over 1 s, of the amplitude", float(apart), 1e-6),
            ("gain and lag over 5 s, float64", double_error, 1e-5),
            ("gain and lag over 5 s, float32", single_error, 1e-3),
        )
    ]
    return not all(good)


def main() -> None:
    """Print the table."""
    options = arguments(__doc__, seconds=2.0, rounds=3).parse_args()
    weak = without_sensors(load_scenario("weak-servo-pi3").changed(duration_s=options.seconds))
    for dtype in (np.float64, np.float32):
        run_batch([weak.changed(duration_s=0.1)], dtype=dtype)  # compiles, the first time
    step_twin(weak.changed(duration_s=0.05), Kernels.NUMBA)
    failed = agreement(weak)
    print(
        f"\n{'on one core, at 1 kHz':<38}{'worlds':>7}{'joints':>7}{'us a step':>11}{'steps/s':>11}"
    )
    for joints in LENGTHS:
        scenario = dataclasses.replace(weak, robot=chain(weak.robot, joints))
        mujoco_run = dataclasses.replace(scenario, engine=EngineKind.MUJOCO)
        ways: dict[tuple[str, int], Callable[[], float]] = {
            (f"batch, {dtype.__name__}", worlds): partial(step_batch, scenario, worlds, dtype)
            for dtype in (np.float64, np.float32)
            for worlds in WORLDS
        }
        ways |= {
            (ON_MUJOCO, 1): partial(step_twin, mujoco_run, Kernels.NUMBA),
            (ON_BULLET, 1): partial(step_twin, scenario, Kernels.NUMBA),
            (BUILT_IN, 1): partial(step_builtin, scenario),
            ("MuJoCo rollout, body alone", 16): partial(step_rollout, scenario, 16, contacts=False),
            ("MuJoCo rollout, its contacts", 16): partial(
                step_rollout, scenario, 16, contacts=True
            ),
        }
        step_us = turns(ways, options.rounds)
        for (name, worlds), costs in step_us.items():
            us = min(costs)
            print(f"{name:<38}{worlds:>7}{joints:>7}{us:>11.2f}{1e6 / us:>11,.0f}", flush=True)
        if joints == 25:
            whole = step_us
    batch, single = whole["batch, float64", 64], whole[ON_MUJOCO, 1]
    what = "step of 25 joints, batch of 64, float64"
    failed |= not compared(what, batch, single, f"single runs on {PEER}", bar=1 / 3, unit="us")
    builtin = whole["MuJoCo rollout, its contacts", 16]
    compared(what, batch, builtin, f"{PEER} rollout, its contacts", unit="us")
    sys.exit(failed)


if __name__ == "__main__":
    main()
