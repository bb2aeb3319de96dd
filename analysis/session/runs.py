"""Which sessions are runs of one gait, and which way its wave runs, by the commands alone.

With c the complex amplitudes of a run's commands, head to tail, another run has the same gait if
its c is the same but for a common phase (it started at another time), and the reverse gait if its
c read from tail to head is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import zip_longest

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.robot.model import Robot, Sensor, SensorKind

from ..common import formats
from ..common.answer import distinct
from ..parts.gait.result import Window
from ..response.fitting import GaitFit
from ..response.response import Response
from ..response.rhythm import phase_step, wave_name
from ..results.analysis import Analysis
from ..results.coupling import Coupling
from ..signals.columns import by_plane

HEADING = "heading_rad"
"""Key of the metadata records ``undulog.plan`` and ``undulog`` with the heading [rad]."""

SAME_COMMAND = 0.01
"""Largest deviation of a command, over its amplitude, that is the same gait still."""

SAME_FREQUENCY = 0.005
"""Relative."""


def coupling_of_one_gait(joints: int) -> Coupling:
    """What one steady gait says about the coupling: nothing, and what would.

    Args:
        joints: Joints with a known response, m.

    Returns:
        Not identifiable, with the reason and the plan to record.
    """
    why = f"one gait gives {joints} complex numbers for {joints * joints} unknown couplings"
    record = (
        f"phase-kicks around this gait ({4 * joints} runs: each joint's command kicked up "
        f"and down, in phase and in amplitude), or without contact a lag-sweep of {joints} gaits"
    )
    if joints == 0:
        why = "no joint's response to a gait is known"
        record = "a session with a steady gait, commands and responses"
    elif joints == 1:
        why = "one joint has no neighbour whose response is known"
        record = "a session with a chain of driven joints"
    return Coupling(identifiable=False, why=why, record=record)


@dataclass(frozen=True)
class Posture:
    """How the robot lay.

    Attributes:
        heading_rad: Direction of its head, counter-clockwise from a direction that is the same in
            all runs [rad]; NaN where it is unknown.
        lean_rad: Fall of the body along itself by recorded gravity, downhill towards the head
            positive [rad]; NaN where none is recorded.
    """

    heading_rad: float = math.nan
    lean_rad: float = math.nan


UNKNOWN_POSTURE = Posture()


def posture(session: SessionView, windows: Sequence[Window]) -> Posture:
    """Read how the robot lay in a session.

    Args:
        windows: Whole gait cycles, over which the motion's own acceleration nearly vanishes.

    Returns:
        The heading of its plan's record, else of its own metadata, else of its twin's start;
        and the lean of its accelerometers, the mean of several.
    """
    return Posture(_heading(session), _lean(session, windows))


def _heading(session: SessionView) -> float:
    for record in ("undulog.plan", "undulog"):
        text = session.metadata.get(record, {}).get(HEADING)
        if text is not None:
            return _number(text)
    return math.nan if session.run is None else session.run.start_heading_rad


def _number(text: object) -> float:
    try:
        value = float(str(text))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _lean(session: SessionView, windows: Sequence[Window]) -> float:
    robot = session.robot
    if robot is None or not windows:
        return math.nan
    leans = [
        lean
        for sensor in robot.sensors
        if sensor.kind is SensorKind.ACCELEROMETER
        and set("xyz") <= set(sensor.axes)
        and sensor.topic in session.channels
        and math.isfinite(lean := _lean_of(session, sensor, windows))
    ]
    return float(np.mean(leans)) if leans else math.nan


def _lean_of(session: SessionView, sensor: Sensor, windows: Sequence[Window]) -> float:
    """Lean of the link that carries one accelerometer; its specific force is gravity's opposite."""
    columns = [f"linear_acceleration.{axis}" for axis in "xyz"]
    logged = session.arrays({sensor.topic: columns})[sensor.topic]
    t_s = (logged.t_ns - session.start_ns) * 1e-9
    inside = np.zeros(len(t_s), dtype=np.bool_)
    for window in windows:
        inside |= (t_s >= window.start_s) & (t_s < window.stop_s)
    if not inside.any() or not set(columns) <= set(logged.values):
        return math.nan
    mean = np.stack([logged.values[name][inside] for name in columns], axis=1).mean(axis=0)
    if not np.isfinite(mean).all():
        return math.nan
    # First and third row of Rz(yaw) Ry(pitch) Rx(roll): the link's x and z.
    roll, pitch, yaw = sensor.rpy
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    x = float(mean @ [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr])
    return math.atan2(-x, float(mean @ [-sp, cp * sr, cp * cr]))


class Role(StrEnum):
    """A run's part in a reversal."""

    FORWARD = "forward"
    REVERSE = "reverse"


@dataclass(frozen=True)
class GaitRun:
    """One session as a run of a gait.

    Attributes:
        label: The file's name, for messages.
        robot: Name of the robot, or None.
        start_ns: When it started [Unix ns].
        names: Driven joints, head to tail, m; none where there is no gait.
        planes: Planes they are in; of several groups, those of the group that is in most.
        frequency_hz: Of the gait; of several groups, the largest group's.
        command: Complex amplitudes of the commands, each at its group's frequency [rad], (m,).
        wave: Which way the wave runs; of several groups, the largest group's.
        response: Response of the joints to their commands, NaN where it isn't known, m joints.
        group: Index of each joint's group, m.
        frequencies_hz: Of each group, the largest group first.
        waves: Which way each group's wave runs.
    """

    label: str
    robot: str | None
    start_ns: int
    names: tuple[str, ...]
    planes: tuple[str, ...]
    frequency_hz: float
    command: ComplexArray
    wave: str | None
    response: Response
    posture: Posture = UNKNOWN_POSTURE
    group: tuple[int, ...] = ()
    frequencies_hz: tuple[float, ...] = ()
    waves: tuple[str | None, ...] = ()

    @property
    def ratio(self) -> ComplexArray:
        """Response over command, NaN where it isn't known, shape (m,)."""
        return self.response.ratio

    @property
    def by_group(self) -> list[IntArray]:
        """Indices of each group's joints."""
        groups = np.array(self.group, dtype=np.int64)
        return [np.flatnonzero(groups == k) for k in range(len(self.frequencies_hz))]


def gait_run(
    label: str,
    robot: Robot | None,
    analysis: Analysis,
    gait: GaitFit | None,
    posture: Posture = UNKNOWN_POSTURE,
) -> GaitRun:
    """What an experiment needs of one session.

    Args:
        label: The file's name.
        robot: Its robot, or None.
        gait: Its fitted gait, or None.
    """
    name, start_ns = analysis.session.robot, analysis.session.start_ns
    if gait is None or not gait.driven:
        nothing = np.zeros(0, dtype=np.complex128)
        return GaitRun(label, name, start_ns, (), (), 0.0, nothing, None, _unknown(0), posture)
    group_of = {joint: k for k, group in enumerate(gait.groups) for joint in group.driven}
    chain = [joint.name for joint in analysis.joints if joint.name in group_of]
    names = tuple(chain) if gait.others else gait.driven
    command = np.zeros(len(names), dtype=np.complex128)
    response = _unknown(len(names))
    answered = {joint.name for joint in analysis.joints if joint.gain.value is not None}
    planes: list[tuple[str, ...]] = []
    waves: list[str | None] = []
    for group in gait.groups:
        fundamental = group.fit.fundamental[: len(group.driven)]
        command[[names.index(joint) for joint in group.driven]] = fundamental
        planes.append(tuple(by_plane(robot, group.driven)))
        waves.append(wave_name(phase_step(fundamental)) if fundamental.size > 1 else None)
        if group.response is None:
            continue
        members = [k for k, joint in enumerate(group.answered) if joint in answered]
        at = [names.index(group.answered[k]) for k in members]
        response.ratio[at] = group.response.ratio[members]
        response.log_gain_variance[at] = group.response.log_gain_variance[members]
        response.lag_variance[at] = group.response.lag_variance[members]
        response.dof[at] = group.response.dof[members]
    return GaitRun(
        label=label,
        robot=name,
        start_ns=start_ns,
        names=names,
        planes=max(planes, key=len),
        frequency_hz=gait.fit.frequency_hz,
        command=command,
        wave=waves[0],
        response=response,
        posture=posture,
        group=tuple(group_of[joint] for joint in names),
        frequencies_hz=tuple(group.fit.frequency_hz for group in gait.groups),
        waves=tuple(waves),
    )


def _unknown(count: int) -> Response:
    """Return the response of joints of which none is known yet."""
    gain, lag, dof = (np.full(count, np.nan) for _ in range(3))
    return Response(np.full(count, np.nan, dtype=np.complex128), gain, lag, dof)


def sort_runs(runs: Sequence[GaitRun]) -> tuple[dict[int, Role], dict[int, str]]:
    """Runs of the commonest gait and of its reverse.

    Returns:
        Roles by index (the wave from head to tail is forward), and why the others have none.
    """
    why = {k: reason for k, run in enumerate(runs) if (reason := _unfit(run)) is not None}
    fit = [k for k in range(len(runs)) if k not in why]
    if not fit:
        return {}, why
    alike = {k: [j for j in fit if _difference(runs[j], runs[k]) is None] for k in fit}
    model = runs[max(fit, key=lambda k: len(alike[k]))]
    roles: dict[int, Role] = {}
    first: dict[bytes, int] = {}
    for k in fit:
        run, numbers = runs[k], runs[k].ratio.tobytes()
        if (different := _difference(run, model)) is not None:
            why[k] = different
        elif numbers in first:
            copied = f"is a copy of the numbers of {runs[first[numbers]].label}"
            why[k] = f"{copied}: a copy is not a run of its own"
        else:
            first[numbers] = k
            roles[k] = Role.FORWARD if run.wave == "head-to-tail" else Role.REVERSE
    return roles, why


def responses(runs: Sequence[GaitRun]) -> tuple[tuple[str, ...], ComplexArray]:
    """Responses of the joints that every run knows, and whose mirror joints every run knows.

    Args:
        runs: Of the same driven joints.

    Returns:
        Names of those joints, head to tail, and y = ln(response/command), shape (runs, joints), its
        imaginary parts within pi of their common mean.
    """
    ratio = np.stack([run.ratio for run in runs])
    finite = np.all(np.isfinite(ratio), axis=0)
    finite &= finite[::-1]
    ratio = ratio[:, finite]
    turn = np.angle((ratio / np.abs(ratio)).sum())
    phase: FloatArray = turn + np.angle(ratio * np.exp(-1j * turn))
    names = tuple(name for name, sound in zip(runs[0].names, finite, strict=True) if sound)
    return names, (np.log(np.abs(ratio)) + 1j * phase).astype(np.complex128)


def mirror_fault(robot: Robot | None, driven: Sequence[str]) -> str | None:
    """Why a robot isn't its own mirror image.

    Args:
        robot: The robot; of None nothing is known, and nothing said against it.
        driven: Names of the driven joints, head to tail.

    Returns:
        The reason, or None where head and tail may change places.
    """
    if robot is None:
        return None
    planes = [joint.plane for joint in robot.joints]
    if planes != planes[::-1]:
        return "its joints' planes, read from tail to head, come in another order"
    shape = [(link.length, link.mass, *link.inertia) for link in robot.links]
    if not np.allclose(shape, shape[::-1], rtol=1e-6, atol=0.0):
        return "its links differ in length, mass or inertia from their mirror images"
    moved = [name in driven for name in robot.joint_names]
    if moved != moved[::-1]:
        return "the driven joints are not their own mirror image"
    return None


def command_change(command: ComplexArray, model: ComplexArray) -> ComplexArray:
    """Each joint's command over that of another run, less the phase that all have in common.

    Args:
        command: Complex amplitudes [rad], shape (m,).
        model: Those of the other run, shape (m,).

    Returns:
        1 where it is the same, shape (m,).
    """
    change: ComplexArray = command / model
    change *= np.exp(-1j * np.angle(change.sum()))
    change *= np.exp(-1j * np.median(np.angle(change)))  # as if the odd joint weren't there
    return change


def command_difference(
    command: ComplexArray, model: ComplexArray, groups: Sequence[IntArray]
) -> tuple[int, str, str] | None:
    """Return where a command is farthest off another, each group of joints by itself.

    Args:
        command: Complex amplitudes [rad], shape (m,).
        model: Those of the other run, shape (m,).
        groups: Indices of the joints at each frequency.

    Returns:
        The joint's index, and its difference in percent of amplitude and degrees of phase; None
        where no joint is farther off than :data:`SAME_COMMAND`.
    """
    change = np.ones_like(command)
    for members in groups:
        change[members] = command_change(command[members], model[members])
    deviation = np.abs(change - 1)
    worst = int(np.argmax(deviation))
    if deviation[worst] <= SAME_COMMAND:
        return None
    percent = formats.number(100 * (float(np.abs(change[worst])) - 1), 1)
    return worst, percent, formats.number(float(np.degrees(np.angle(change[worst]))), 1)


def other_frequency(run: GaitRun, model: GaitRun) -> tuple[str, str] | None:
    """Find a group whose frequency is not the model's.

    Returns:
        Both frequencies [Hz] of the first such group, with the digits in which they differ; None
        where they agree.
    """
    pairs = zip_longest(run.frequencies_hz, model.frequencies_hz, fillvalue=float("nan"))
    for frequency, other in pairs:
        if not abs(frequency - other) <= SAME_FREQUENCY * other:
            return distinct(frequency, other)
    return None


def _unfit(run: GaitRun) -> str | None:
    if not run.names:
        return "has no gait"
    if len(run.planes) > 1:
        return "drives both planes; the reversal test is made of one wave"
    if any(wave in (None, "standing") for wave in run.waves):
        return "has no travelling wave, so there is no reverse of it"
    if not np.isfinite(run.ratio).any():
        return "has no gain and lag"
    return None


def _other_drive(run: GaitRun, model: GaitRun) -> str | None:
    """What a run drives otherwise than the model; None if nothing but the wave differs."""
    if run.robot != model.robot:
        return f"is of {run.robot or 'no known robot'}, {model.label} of {model.robot or 'none'}"
    if run.names != model.names:
        return f"drives other joints than {model.label}"
    if run.group != model.group:
        return f"has other joints than {model.label} at one frequency"
    other = other_frequency(run, model)
    return None if other is None else f"has {other[0]} Hz, {model.label} {other[1]} Hz"


def _difference(run: GaitRun, model: GaitRun) -> str | None:
    """What makes a run another gait than the model's or its reverse; None if nothing does."""
    if (drive := _other_drive(run, model)) is not None:
        return drive
    same = [wave == way for wave, way in zip(run.waves, model.waves, strict=True)]
    if any(same) != all(same):
        return f"has another direction of the wave than {model.label} in some groups only"
    if not all(same) and run.group != run.group[::-1]:
        return (
            f"has the reverse wave of {model.label}, but its joints' frequencies, read from tail "
            "to head, come in another order"
        )
    command = run.command if all(same) else run.command[::-1]
    if (off := command_difference(command, model.command, model.by_group)) is None:
        return None
    worst, percent, degrees = off
    joint = run.names[worst if all(same) else -1 - worst]
    return (
        f"commands another gait than {model.label}: at {joint} the amplitude is {percent} % and "
        f"the phase {degrees} degrees off"
    )
