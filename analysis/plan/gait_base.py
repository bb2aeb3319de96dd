"""The gait that a plan is made around: the sines that a recorded session commanded.

How long a straight chain rings without contact: its slowest mode, in closed form.

At small angles a straight chain moves across itself by y_0 + theta_0 x + the joints' bends, so its
mass matrix is constant; with the servos linear (no Coulomb friction, no play, no saturation) the
modes are the eigenvalues of

    M_eff q'' = k_g (th - q) + c_g (om - q')
    Jm om'    = -kappa q - (b + Kt^2/R) om - k_g (th - q) - c_g (om - q'),   kappa = Kt V Kp / R

with M_eff = M_qq - M_qb M_bb^-1 M_bq, the free body b eliminated. Ground and Coulomb friction only
add damping. What is measured before these modes have died away is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import UsageError
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from undulog.capture.robot.model import Joint, Plane, Robot

from ..results.answer import Remarks, percent
from ..session.analyse import measure_session
from ..signals.columns import read_columns

TIME_CONSTANTS = 5.0
"""So many of the slowest mode's time constants are waited for: 0.7 % of it is left."""


@dataclass(frozen=True)
class Mode:
    """A decaying mode.

    Attributes:
        frequency_hz: Its natural frequency, |s| / 2 pi.
        damping: Damping ratio, -Re s / |s|.
        time_constant_s: -1 / Re s.
    """

    frequency_hz: float
    damping: float
    time_constant_s: float


def slowest_mode(robot: Robot, driven: Sequence[str]) -> Mode:
    """Find the mode of the driven planes that decays slowest.

    Args:
        driven: Names of the driven joints, at least one.
    """
    poles = np.concatenate(
        [
            _poles(robot, plane)
            for plane in Plane
            if any(joint.plane is plane and joint.name in driven for joint in robot.joints)
        ]
    )
    slowest = complex(poles[int(np.argmax(poles.real))])
    size = abs(slowest)
    return Mode(size / (2 * np.pi), -slowest.real / size, -1 / slowest.real)


def transverse_mass(robot: Robot, plane: Plane) -> FloatArray:
    """Return the mass matrix of the free straight chain bending in one plane.

    Args:
        plane: The plane; joints of the other one are rigid.

    Returns:
        Of the joints of that plane once the free body is eliminated, shape (m, m) [kg m^2].
    """
    length = np.array([link.length for link in robot.links])
    mass = np.array([link.mass for link in robot.links])
    axis = 2 if plane is Plane.HORIZONTAL else 1
    inertia = np.array([link.inertia[axis] for link in robot.links])
    back = np.cumsum(length)  # from the head's front; only differences count
    centre = back - length / 2
    joints: IntArray = robot.joint_indices(plane)
    behind = (np.arange(len(length))[:, None] > joints[None, :]).astype(np.float64)
    # Columns: shift, turn about the front, bends; each link's centre across, and its angle.
    shift = np.column_stack(
        [np.ones_like(centre), centre, behind * (centre[:, None] - back[joints])]
    )
    turn = np.column_stack([np.zeros_like(centre), np.ones_like(centre), behind])
    whole = shift.T @ (mass[:, None] * shift) + turn.T @ (inertia[:, None] * turn)
    free = np.linalg.solve(whole[:2, :2], whole[:2, 2:])
    return whole[2:, 2:] - whole[2:, :2] @ free


def _poles(robot: Robot, plane: Plane) -> ComplexArray:
    """Return eigenvalues of (q, q', th, om), of the joints of one plane."""
    joints: list[Joint] = [joint for joint in robot.joints if joint.plane is plane]
    servos = [joint.servo for joint in joints]
    winding = np.array([one.torque_constant / one.resistance_ohm for one in servos])
    kappa = np.diag(winding * [one.supply_v * one.proportional_gain for one in servos])
    drag = np.diag(
        winding * [one.torque_constant for one in servos] + [one.viscous_friction for one in servos]
    )
    k = np.diag([one.gear_stiffness for one in servos])
    c = np.diag([one.gear_damping for one in servos])
    body = np.linalg.inv(transverse_mass(robot, plane))
    rotor = np.diag([1 / one.rotor_inertia for one in servos])
    none, unit = np.zeros_like(k), np.eye(len(k))
    matrix = np.block(
        [
            [none, unit, none, none],
            [-body @ k, -body @ c, body @ k, body @ c],
            [none, none, none, unit],
            [rotor @ (k - kappa), rotor @ c, -rotor @ k, -rotor @ (drag + c)],
        ]
    )
    return np.linalg.eigvals(matrix).astype(np.complex128)


PURE = 0.01
"""Harmonics of a command above this share of its fundamental are no sine any more."""


@dataclass(frozen=True)
class BaseGait:
    """Sines around offsets; a joint without amplitude is held.

    Attributes:
        names: All joints, head to tail, n.
        driven: Indices of those that the gait drives, m.
        amplitude: Complex amplitudes of the driven ones' commands [rad], shape (m,).
        offset: Of all joints [rad], shape (n,).
        omega: Angular frequency [rad/s].
    """

    names: tuple[str, ...]
    driven: tuple[int, ...]
    amplitude: ComplexArray
    offset: FloatArray
    omega: float


def base_gait(session: SessionView) -> BaseGait:
    """Fit the gait of a session's commands.

    Args:
        session: An open session with commands.

    Raises:
        UsageError: If it commands no steady gait of sines.
    """
    gait = measure_session(session, with_dead_bands=False).gait
    if gait is None or not gait.driven:
        raise UsageError(f"{session.path}: it commands no steady gait; name a session that does")
    if gait.others:
        frequencies = ", ".join(f"{one.fit.frequency_hz:.4g} Hz" for one in gait.groups)
        raise UsageError(
            f"{session.path}: its joints have several frequencies ({frequencies}); name a session "
            "of one"
        )
    m = len(gait.driven)
    harmonics = gait.fit.amplitudes[:m]
    overtones = np.abs(harmonics[:, 1:]).max(initial=0.0, axis=1) / np.abs(harmonics[:, 0])
    if overtones.max() > PURE:
        worst = gait.driven[int(np.argmax(overtones))]
        share = percent(float(overtones.max()), PURE)
        raise UsageError(
            f"{session.path}: the command of {worst} is no sine (a harmonic has {share} of its "
            f"amplitude, more than {100 * PURE:g} %); name a session of a steady sine gait"
        )
    commands = read_columns(session, COMMAND_TOPIC, RESPONSE_TOPIC, Remarks()).command
    names = tuple(commands)
    # Of a joint that is held, every sample is its place.
    offset = np.array([float(commands[name].values[-1]) for name in names])
    driven = tuple(names.index(name) for name in gait.driven)
    offset[list(driven)] = gait.fit.trend[:m, 0]
    return BaseGait(names, driven, gait.fit.fundamental[:m], offset, gait.fit.omega)


def base_pose(session: SessionView, joints: Sequence[str] | None, omega: float) -> BaseGait:
    """Return the pose around which a session's joints are commanded, with nothing moving.

    Args:
        session: An open session with commands of any kind.
        joints: Those to be driven; those that the session drives if None.
        omega: Angular frequency of what will be commanded [rad/s].

    Returns:
        The joints; each offset is half-way between the least and the largest command.

    Raises:
        UsageError: If it has no commands, drives no joint, or has no joint of a name.
    """
    columns = read_columns(session, COMMAND_TOPIC, RESPONSE_TOPIC, Remarks())
    ends = {
        name: (float(np.nanmin(one.values)), float(np.nanmax(one.values)))
        for name, one in columns.command.items()
        if np.isfinite(one.values).any()
    }
    names = tuple(name for name in columns.names if name in ends)
    chosen = columns.commanded() if joints is None else tuple(dict.fromkeys(joints))
    if not chosen:
        raise UsageError(
            f"{session.path}: it commands no motion; choose the joints to drive by --joints"
            if names
            else f"{session.path}: it has no commands; name a session that has"
        )
    if missing := [name for name in chosen if name not in names]:
        raise UsageError(
            f"{session.path}: no commands of {', '.join(missing)}; its joints are "
            f"{', '.join(names[:_LISTED])}{' ...' if len(names) > _LISTED else ''}"
        )
    offset = np.array([sum(ends[name]) / 2 for name in names])
    driven = tuple(k for k, name in enumerate(names) if name in chosen)
    return BaseGait(names, driven, np.zeros(len(driven), dtype=np.complex128), offset, omega)


_LISTED = 12
