"""A twin whose servos rest: its dead band is (t_s + t_c) over the servo's stiffness wide."""

import dataclasses
import math

import numpy as np
import pytest

from support.resting import STEP, found_in
from undulog.capture import load_robot
from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Scenario, Serpentine, Twin, World
from undulog.sim.scenario.scenario import Kernels


@dataclasses.dataclass
class Logged:
    """A joint of the twin, as its encoder has it."""

    t_s: np.ndarray
    command: np.ndarray
    position: np.ndarray


def two_joints(width, stall_torque):
    """Two yaw joints of a short robot in free space, in steps of the encoder."""
    robot = load_robot("snake13-planar")
    friction = width * robot.joints[0].servo.proportional_gain * stall_torque / 2
    servo = dataclasses.replace(
        robot.joints[0].servo,
        stall_torque=stall_torque,
        static_friction=friction,
        coulomb_friction=friction,
    )
    joints = tuple(dataclasses.replace(joint, servo=servo) for joint in robot.joints[:2])
    scenario = Scenario(
        name="rest",
        description="two joints with stick",
        robot_name="short",
        robot=dataclasses.replace(robot, links=robot.links[:3], joints=joints, sensors=()),
        gait=Serpentine({Plane.HORIZONTAL: PlaneGait(0.3, 0.5, math.pi / 3)}, 0.5),
        world=World(ground=None, gravity=(0.0, 0.0, 0.0)),
        physics_rate_hz=4000,
        duration_s=12.0,
    )
    with Twin(scenario, kernels=Kernels.NUMBA) as twin:
        rows = [
            (sample.time_s, sample.gait.command.copy(), sample.step.body.angle.copy())
            for sample in twin.samples()
            if sample.time_s >= 2.0
        ]
    t_s = np.array([row[0] for row in rows])
    commands, angles = (np.array([row[k] for row in rows]) for k in (1, 2))
    seen = np.round(angles / STEP) * STEP
    return [Logged(t_s, commands[:, j], seen[:, j]) for j in range(2)]


@pytest.mark.nightly
@pytest.mark.parametrize("stall_torque", [1.5, 0.25])
@pytest.mark.parametrize("steps", [6, 20])
def test_its_width_is_found_within_a_tenth_and_covered(steps, stall_torque):
    width = steps * STEP
    bands, _ = found_in(two_joints(width, stall_torque))
    assert set(bands) == {0, 1}
    for band in bands.values():
        for end in (band.top, band.bottom):
            assert end.travel_rad == pytest.approx(width, rel=0.1)
            assert end.travel_ci95[0] <= width <= end.travel_ci95[1]
            assert end.step_ci95[0] == 0.0
