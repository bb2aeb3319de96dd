"""Is the physics step short enough for the stiff parts of a scenario?

Each part is taken alone, as a spring or damper between two free masses stepped by the
semi-implicit Euler rule, which is stable for omega dt < 2 (spring) and c dt / m < 2 (damper). The
coupled robot has other bounds, so this ranks suspects; it proves nothing. Too small a smoothing of
Coulomb friction does not blow up, since that is bounded: it makes the robot tremble.
"""

from __future__ import annotations

import math

from .scenario import Scenario
from .world import FrictionLaw


def stability_numbers(scenario: Scenario) -> dict[str, float]:
    """How much of its stability range each stiff part uses, alone.

    Args:
        scenario: The scenario.

    Returns:
        Name of the parameter to the share used: above about 1 the part is unstable.
    """
    dt = 1.0 / scenario.physics_rate_hz
    robot, ground = scenario.robot, scenario.world.ground
    shares: dict[str, float] = {}
    if ground is not None:
        mass = min(link.mass for link in robot.links)
        # A sideways force at the contact point, r below the centre, also rolls the link.
        roll = max(1 + part.mass * part.radius**2 / part.inertia[0] for part in robot.links)
        shares["world.ground.stiffness"] = ground.stiffness * dt**2 / mass / 4
        shares["world.ground.damping"] = ground.damping * dt / mass / 2
        if ground.law is FrictionLaw.VISCOUS:
            for name in ("drag_tangential", "drag_normal"):
                shares[f"world.ground.{name}"] = getattr(ground, name) * roll * dt / mass / 2
        else:
            mu = max(ground.mu_normal, ground.mu_tangential)
            g = math.hypot(*scenario.world.gravity)
            shares["world.ground.slip_speed"] = mu * g * roll * dt / ground.slip_speed / 2
    # Links turn about a joint with the inertia about their ends.
    link = min(min(part.inertia) + part.mass * part.length**2 / 4 for part in robot.links)
    for joint in robot.joints:
        servo = joint.servo
        compliance = 1 / servo.rotor_inertia + 2 / link
        springs = servo.gear_stiffness * dt**2 * compliance / 4
        dampers = servo.gear_damping * dt * compliance / 2
        motor = servo.viscous_friction + servo.torque_constant**2 / servo.resistance_ohm
        own = {
            "gear_stiffness": springs,
            "gear_damping": dampers,
            "rotor_inertia": motor * dt / servo.rotor_inertia / 2,
        }
        for name, share in own.items():
            shares[f"servo.{name}"] = max(share, shares.get(f"servo.{name}", 0.0))
    return shares


def warnings(scenario: Scenario) -> tuple[str, ...]:
    """What is too stiff for the step.

    Args:
        scenario: The scenario.

    Returns:
        One sentence for each parameter beyond its stability range.
    """
    return tuple(
        f"{_verdict(name, share, scenario)}: expect vibration or failure"
        for name, share in stability_numbers(scenario).items()
        if share > 1.0
    )


def likely_cause(scenario: Scenario) -> str:
    """Name the stiffest part.

    Args:
        scenario: The scenario that failed.

    Returns:
        A clause for an error message.
    """
    shares = stability_numbers(scenario)
    shares.pop("world.ground.slip_speed", None)  # Coulomb friction is bounded
    name, share = max(shares.items(), key=lambda item: item[1])
    if share < 0.5:
        return "no parameter is too stiff for the step: look at the gait and the start"
    return f"likely cause: {_verdict(name, share, scenario)}; soften it or raise physics_rate_hz"


def _verdict(name: str, share: float, scenario: Scenario) -> str:
    step_ms = 1e3 / scenario.physics_rate_hz
    return f"{name} is too stiff for steps of {step_ms:g} ms ({share:.2g} of its stability range)"
