"""What is fitted: x = ln(theta / theta_0), so that every parameter stays positive.

The servo's parameters are shared by all modules, the ground's by all links; one module may have a
stall torque of its own. A dead time is no parameter of the twin: it is fitted to the times of the
samples, in units of its own prior deviation.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Servo
from undulog.sim.scenario.scenario import Scenario
from undulog.sim.scenario.world import FrictionLaw

SERVO = {
    "stall_torque": "N m",
    "proportional_gain": "1/rad",
    "coulomb_friction": "N m",
    "viscous_friction": "N m s/rad",
    "gear_stiffness": "N m/rad",
    "gear_damping": "N m s/rad",
}
"""Shared servo parameters and their units."""

_DRY = {"mu_tangential": "1", "mu_normal": "1"}
_VISCOUS = {"drag_tangential": "N s/m", "drag_normal": "N s/m"}

DELAY = "delay"
DELAY_S = 0.02
"""Prior standard deviation of the dead time [s]."""


@dataclass(frozen=True)
class Unknown:
    """One entry of x.

    Attributes:
        name: A servo's or the ground's parameter, or :data:`DELAY`.
        unit: SI.
        start: theta_0; 0 for a dead time.
        spread: Prior standard deviation of its entry of x.
        module: The joint whose own parameter it is, as a factor on the shared one; None for all.
    """

    name: str
    unit: str
    start: float
    spread: float
    module: str | None = None

    @property
    def label(self) -> str:
        """How it is called in text."""
        words = self.name.replace("_", " ")
        return words if self.module is None else f"{words} of {self.module}"

    def value(self, x: float) -> float:
        """Theta in its unit: of a module, its factor on the shared value."""
        return DELAY_S * x if self.name == DELAY else self.start * math.exp(x)


def unknowns(
    scenario: Scenario, *, spread: float, only: Sequence[str] = (), delay: bool = False
) -> tuple[Unknown, ...]:
    """What can be fitted of a scenario.

    Args:
        scenario: Where the commands will be given; its servos identical.
        spread: Prior standard deviation of each ln theta.
        only: Names of the parameters wanted; all if empty.
        delay: Fit a dead time, too.

    Returns:
        Those of its servos and of its ground that aren't 0: what is absent stays absent.

    Raises:
        UsageError: If the servos differ, or a name is none of them.
    """
    servos = {joint.servo for joint in scenario.robot.joints}
    if len(servos) > 1:
        raise UsageError(
            f"{scenario.name}: its servos differ and shared parameters are to be fitted; leave out "
            "servo_of and the joints' own servos"
        )
    (servo,) = servos
    ground = scenario.world.ground
    of_law = _VISCOUS if ground is not None and ground.law is FrictionLaw.VISCOUS else _DRY
    parameters = {
        name: Unknown(name, unit, float(getattr(owner, name)), spread)
        for owner, units in ((servo, SERVO), (ground, of_law))
        for name, unit in (units.items() if owner is not None else ())
    }
    for name in only:
        if name not in parameters:
            raise UsageError(f"--only {name}: expected one of {', '.join(parameters)}")
        if parameters[name].start == 0.0:
            raise UsageError(f"--only {name}: it is 0 in {scenario.name} and can't be scaled")
    selected = [parameter for name, parameter in parameters.items() if not only or name in only]
    chosen = tuple(parameter for parameter in selected if parameter.start > 0.0)
    return (*chosen, Unknown(DELAY, "s", 0.0, 1.0)) if delay else chosen


def module_unknown(scenario: Scenario, joint: str, spread: float) -> Unknown:
    """The stall torque of one module, as a factor on that of all.

    Args:
        scenario: Where the commands will be given.
        spread: Prior standard deviation of the factor's logarithm.

    Raises:
        UsageError: If there is no such joint.
    """
    names = scenario.robot.joint_names
    if joint not in names:
        raise UsageError(f"--module {joint}: {scenario.robot.name} has {', '.join(names)}")
    return Unknown("stall_torque", "1", 1.0, spread, joint)


def with_values(scenario: Scenario, parameters: Sequence[Unknown], x: FloatArray) -> Scenario:
    """The scenario with other parameters.

    Args:
        scenario: With theta_0.
        parameters: K unknowns.
        x: Shape (K,).

    Returns:
        The scenario to run; its tables of modules are left as they were.
    """
    shared, of_ground, factor = dict[str, float](), dict[str, float](), dict[str, float]()
    for parameter, entry in zip(parameters, x.tolist(), strict=True):
        if parameter.module is not None:
            factor[parameter.module] = parameter.value(entry)
        elif parameter.name in SERVO:
            shared[parameter.name] = parameter.value(entry)
        elif parameter.name != DELAY:
            of_ground[parameter.name] = parameter.value(entry)
    joints = tuple(
        dataclasses.replace(joint, servo=_servo(joint.servo, shared, factor.get(joint.name, 1.0)))
        for joint in scenario.robot.joints
    )
    robot, world = dataclasses.replace(scenario.robot, joints=joints), scenario.world
    if world.ground is not None:
        world = dataclasses.replace(world, ground=dataclasses.replace(world.ground, **of_ground))
    return dataclasses.replace(scenario, robot=robot, world=world)


def _servo(servo: Servo, shared: dict[str, float], factor: float) -> Servo:
    given = dataclasses.replace(servo, **shared)
    return dataclasses.replace(given, stall_torque=given.stall_torque * factor)


def late_s(parameters: Sequence[Unknown], x: FloatArray) -> float:
    """Dead time among the unknowns [s]."""
    pairs = zip(parameters, x.tolist(), strict=True)
    return sum(parameter.value(entry) for parameter, entry in pairs if parameter.name == DELAY)
