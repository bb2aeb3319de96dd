"""From a scenario to its gait: the generator alone, or under the scenario's controller."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..gait.build import generator
from ..gait.contract import Gait
from ..scenario.controllers import RandomTurns, TargetHeading
from .adaptive import AdaptiveGait
from .course import Course, RandomCourse, StraightOn, TargetCourse
from .reckoning import turned

if TYPE_CHECKING:
    from ..scenario.scenario import Scenario


def build_gait(scenario: Scenario) -> Gait:
    """The gait that a scenario asks for, on the twin or on a bus.

    Args:
        scenario: Gait, controller and robot; of its world and its sensors only what the robot is
            told beforehand: where the target lies from its start, and which way north is there.

    Returns:
        The gait, at time zero.
    """
    robot, controller = scenario.robot, scenario.controller
    if controller is None:
        return generator(scenario.gait, robot)
    # A controller bends and shrinks joint by joint, and the log is to hold what each was given.
    wave = generator(scenario.gait, robot, per_joint=True)
    return AdaptiveGait(wave, controller, _course(scenario), robot)


def _course(scenario: Scenario) -> Course:
    controller, target = scenario.controller, scenario.world.target
    course = controller.course if controller is not None else None
    if isinstance(course, RandomTurns):
        return RandomCourse(course, scenario.seed)
    if controller is not None and isinstance(course, TargetHeading) and target is not None:
        north = scenario.sensing.compass.north
        x, y = turned(np.array(target.position), -north).tolist()
        radius_m = controller.calibration.turn_radius_m
        return TargetCourse(course, (x, y), target.radius, radius_m, scenario.robot)
    return StraightOn()
