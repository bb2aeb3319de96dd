"""Is the physics step short enough for the stiff parts of a scenario?

The straight robot, at rest on level ground, is a linear system M z'' + C z' + K z = 0 of springs
and dampers: gears, motors, ground, and an obstacle, where there are any, at that link's end which
gives way most easily. Its motions in the horizontal plane (sideways, yaw, roll) and in
the vertical one (along, up, pitch) are independent. Stepped by the semi-implicit Euler rule, a
motion loses its stability when it turns its sign at every step, z -> -z; put into the rule, that is

    (2 dt C + dt^2 K) v = 4 s M v   with s = 1.

So the largest s is the share of the stability range that is used, exactly so for this linear
system. A bent robot is stiffer. The servos' control loops are left out: they are slow.

Coulomb's frictions are dampers while they are smooth, but they are bounded: too small a smoothing
makes the robot tremble, and does not blow it up.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane, Robot

from ..physics.obstacle_contact import yielding
from ..physics.servo import COULOMB_SPEED, Servos
from ..scenario.scenario import Scenario
from ..scenario.world import FrictionLaw

_BOUNDED = (
    *("world.ground.slip_speed", "servo.coulomb_friction"),
    "world.obstacle_contact.slip_speed",
)
_ACROSS, _TURN, _OTHER, _BASE = range(4)
"""The base has three coordinates: its shift across the body, its turn, and, as the third, its roll
(horizontal plane) or its shift along the body (vertical plane)."""


class Use(NamedTuple):
    """How the motion of one plane that is closest to its bound uses its stability range.

    Attributes:
        share: Used of the range: beyond 1 the motion is unstable.
        parts: What each parameter adds to that.
    """

    share: float
    parts: dict[str, float]

    @property
    def stiffest(self) -> str:
        """The parameter that adds most."""
        return max(self.parts, key=self.parts.__getitem__)


def stability(scenario: Scenario, *, friction: bool = True) -> dict[Plane, Use]:
    """How much of their stability range the motions of the straight robot use.

    Args:
        friction: Count Coulomb's frictions, whose forces are bounded.

    Returns:
        The motion closest to its bound, by plane.
    """
    return {plane: _use(scenario, plane, friction=friction) for plane in Plane}


def warnings(scenario: Scenario) -> tuple[str, ...]:
    """What is too stiff for the step, or too soft for the robot.

    Returns:
        One sentence for each plane whose motion is unstable, and one where the ground is too soft.
    """
    stiff = tuple(
        f"{_verdict(use, scenario)}: expect vibration or failure"
        for use in stability(scenario).values()
        if use.share > 1.0
    )
    sunk = _sunk(scenario)
    return stiff if sunk is None else (*stiff, sunk)


def likely_cause(scenario: Scenario) -> str:
    """Name the stiffest part, or the link that the ground does not carry.

    Returns:
        A clause for an error message.
    """
    use = max(stability(scenario, friction=False).values(), key=lambda use: use.share)
    if use.share <= 1.0 and (sunk := _sunk(scenario)) is not None:
        return f"likely cause: {sunk}"
    if use.share <= 1.0:
        return "no parameter is too stiff for the step: look at the gait and the start"
    return f"likely cause: {_verdict(use, scenario)}; soften it or raise physics_rate_hz"


def _verdict(use: Use, scenario: Scenario) -> str:
    step_ms = 1e3 / scenario.physics_rate_hz
    return (
        f"{use.stiffest} is too stiff for steps of {step_ms:g} ms "
        f"({use.share:.2g} of the stability range)"
    )


def _sunk(scenario: Scenario) -> str | None:
    """Return a warning where a link's weight presses it into the ground by more than its radius."""
    ground = scenario.world.ground
    if ground is None:
        return None
    pull = max(-scenario.world.gravity[2], 0.0) / ground.stiffness
    depth, link = max(
        ((link.mass * pull / link.radius, link) for link in scenario.robot.links),
        key=lambda pair: pair[0],
    )
    if depth <= 1.0:
        return None
    return (
        f"{link.name} is too heavy for world.ground.stiffness: with {link.mass:g} kg it rests "
        f"{link.mass * pull:.2g} m deep"
    )


def _use(scenario: Scenario, plane: Plane, *, friction: bool) -> Use:
    robot = scenario.robot
    servos = Servos([joint.servo for joint in robot.joints if joint.plane is plane])
    shift, turn = _chain(robot, plane)
    mass = _mass(robot, plane, servos, shift, turn)
    parts = {
        part.name: part.rows.T @ (part.strength[:, np.newaxis] * part.rows) / 4
        for part in (
            *_servo_parts(scenario, servos),
            *_ground_parts(scenario, plane, shift, turn),
            *_obstacle_parts(scenario, plane, shift, turn, mass),
        )
        if friction or part.name not in _BOUNDED
    }
    total = np.sum([*parts.values(), 0.0 * mass], axis=0)
    root = np.linalg.inv(np.linalg.cholesky(mass))
    shares, motions = np.linalg.eigh(root @ total @ root.T)
    worst = root.T @ motions[:, -1]  # worst' M worst = 1
    return Use(
        float(shares[-1]), {name: float(worst @ part @ worst) for name, part in parts.items()}
    )


def _chain(robot: Robot, plane: Plane) -> tuple[FloatArray, FloatArray]:
    """Small motions of the links across the straight body, by coordinate.

    The coordinates are those of the base, then the joints of the plane, then their rotors.
    """
    joints = robot.joint_indices(plane)
    half = np.array([[link.length / 2] for link in robot.links])
    turn = np.zeros((len(half), _BASE + 2 * len(joints)))
    turn[:, _TURN] = 1.0
    for k, j in enumerate(joints, _BASE):
        turn[j + 1 :, k] = 1.0
    shift = np.zeros_like(turn)
    shift[:, _ACROSS] = 1.0
    shift[1:] -= np.cumsum(half[:-1] * turn[:-1] + half[1:] * turn[1:], axis=0)
    return shift, turn


def _mass(
    robot: Robot, plane: Plane, servos: Servos, shift: FloatArray, turn: FloatArray
) -> FloatArray:
    mass = np.array([[link.mass] for link in robot.links])
    roll, pitch, yaw = np.array([link.inertia for link in robot.links]).T[:, :, np.newaxis]
    flat = plane is Plane.HORIZONTAL
    matrix = shift.T @ (mass * shift) + turn.T @ ((yaw if flat else pitch) * turn)
    matrix[_OTHER, _OTHER] = (roll if flat else mass).sum()
    rotors = np.arange(len(matrix) - len(servos.inertia), len(matrix))
    matrix[rotors, rotors] = servos.inertia
    return matrix


class _Part(NamedTuple):
    """Springs or dampers of one kind: 2 dt c or dt^2 k of each, and what stretches it."""

    name: str
    strength: FloatArray  # shape (k,)
    rows: FloatArray  # shape (k, d)


def _servo_parts(scenario: Scenario, servos: Servos) -> Iterator[_Part]:
    dt, m = 1.0 / scenario.physics_rate_hz, len(servos.inertia)
    rotor = np.eye(m, _BASE + 2 * m, _BASE + m)
    twist = rotor - np.eye(m, _BASE + 2 * m, _BASE)
    yield _Part("servo.gear_stiffness", dt**2 * servos.gear_stiffness, twist)
    yield _Part("servo.gear_damping", 2 * dt * servos.gear_damping, twist)
    motor = servos.viscous + servos.torque_constant**2 / servos.resistance
    yield _Part("servo.rotor_inertia", 2 * dt * motor, rotor)
    smooth = np.where(servos.static > 0, 0.0, servos.coulomb)  # with rest it is stepped implicitly
    yield _Part("servo.coulomb_friction", 2 * dt * smooth / COULOMB_SPEED, rotor)


def _ground_parts(
    scenario: Scenario, plane: Plane, shift: FloatArray, turn: FloatArray
) -> Iterator[_Part]:
    dt, robot, ground = 1.0 / scenario.physics_rate_hz, scenario.robot, scenario.world.ground
    if ground is None:
        return
    unit = np.ones(len(robot.links))
    # The contact points lie r below the centres: roll and pitch move them too.
    radius = np.array([[link.radius] for link in robot.links])
    slip, other = (
        (shift, radius) if plane is Plane.HORIZONTAL else (radius * turn, unit[:, np.newaxis])
    )
    slip = slip.copy()
    slip[:, [_OTHER]] = other
    way = "normal" if plane is Plane.HORIZONTAL else "tangential"
    mu, drag = (float(getattr(ground, f"{kind}_{way}")) for kind in ("mu", "drag"))
    if plane is Plane.VERTICAL:
        yield _Part("world.ground.stiffness", dt**2 * ground.stiffness * unit, shift)
        yield _Part("world.ground.damping", 2 * dt * ground.damping * unit, shift)
    if ground.law is FrictionLaw.VISCOUS:
        yield _Part(f"world.ground.drag_{way}", 2 * dt * drag * unit, slip)
    else:
        load = np.array([link.mass for link in robot.links]) * max(-scenario.world.gravity[2], 0.0)
        yield _Part("world.ground.slip_speed", 2 * dt * mu * load / ground.slip_speed, slip)


def _obstacle_parts(
    scenario: Scenario, plane: Plane, shift: FloatArray, turn: FloatArray, mass: FloatArray
) -> Iterator[_Part]:
    """An obstacle at the end of a link, the one with the least mass behind it.

    Obstacles push sideways only. Their friction is at most a damper that stops the link, were it
    free, within one step, however hard it is pressed (:mod:`.sim.physics.obstacle_contact`).
    """
    if plane is Plane.VERTICAL or not scenario.world.obstacles:
        return
    dt, material = 1.0 / scenario.physics_rate_hz, scenario.world.obstacle_contact
    half = np.array([[link.length / 2] for link in scenario.robot.links])
    ends = np.concatenate([shift + half * turn, shift - half * turn])
    give = (ends * np.linalg.solve(mass, ends.T).T).sum(axis=1)  # 1 / mass behind each
    at = int(np.argmax(give))
    weakest, unit = ends[[at]], np.ones(1)
    yield _Part("world.obstacle_contact.stiffness", dt**2 * material.stiffness * unit, weakest)
    yield _Part("world.obstacle_contact.damping", 2 * dt * material.damping * unit, weakest)
    if material.mu > 0.0:
        link = scenario.robot.links[at % len(half)]
        arm = (link.length / 2) ** 2 + link.radius**2
        stopping = 2.0 / yielding(arm * unit, link.mass * unit, min(link.inertia) * unit)
        yield _Part("world.obstacle_contact.slip_speed", stopping, weakest)
