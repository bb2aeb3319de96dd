"""Which sessions are runs of one gait, and which way its wave runs: told from the commands alone.

With c the complex amplitudes of a run's commands, head to tail, another run has the same gait if
its c is the same but for a common phase (it started at another time), and the reverse gait if its
c read from tail to head is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from capture.arrays import ComplexArray, FloatArray
from capture.robot import Robot

from ..fitting import GaitFit
from ..gait import phase_step, wave_name
from ..reading import by_plane
from ..response import Response
from ..results.analysis import Analysis
from ..reversal.posture import UNKNOWN_POSTURE, Posture
from ..text import formats

SAME_COMMAND = 0.01
"""Largest deviation of a command, over its amplitude, that is the same gait still."""

SAME_FREQUENCY = 0.005
"""Relative."""


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
        planes: Planes they are in.
        frequency_hz: Of the gait.
        command: Complex amplitudes of the commands [rad], shape (m,).
        wave: Which way the wave runs.
        response: Response of the joints to their commands, NaN where it isn't known, m joints.
        posture: How the robot lay.
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
    posture: Posture

    @property
    def ratio(self) -> ComplexArray:
        """Response over command, NaN where it isn't known, shape (m,)."""
        return self.response.ratio


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
        analysis: Its numbers.
        gait: Its fitted gait, or None.
        posture: How the robot lay.

    Returns:
        The run.
    """
    name, start_ns = analysis.session.robot, analysis.session.start_ns
    if gait is None or not gait.driven:
        nothing = np.zeros(0, dtype=np.complex128)
        return GaitRun(label, name, start_ns, (), (), 0.0, nothing, None, _unknown(0), posture)
    count = len(gait.driven)
    command = gait.fit.fundamental[:count]
    response = _unknown(count)
    known = {joint.name for joint in analysis.joints if joint.gain.value is not None}
    if gait.response is not None:
        own = [k for k, joint in enumerate(gait.answered) if joint in known]
        at = [gait.command_of(gait.answered[k]) for k in own]
        response.ratio[at] = gait.response.ratio[own]
        response.log_gain_variance[at] = gait.response.log_gain_variance[own]
        response.lag_variance[at] = gait.response.lag_variance[own]
        response.dof[at] = gait.response.dof[own]
    return GaitRun(
        label=label,
        robot=name,
        start_ns=start_ns,
        names=gait.driven,
        planes=tuple(by_plane(robot, gait.driven)),
        frequency_hz=gait.fit.frequency_hz,
        command=command,
        wave=wave_name(phase_step(command)) if count > 1 else None,
        response=response,
        posture=posture,
    )


def _unknown(count: int) -> Response:
    """The response of joints of which none is known yet."""
    none = [np.full(count, np.nan) for _ in range(3)]
    return Response(np.full(count, np.nan, dtype=np.complex128), *none)


def sort_runs(runs: Sequence[GaitRun]) -> tuple[dict[int, Role], dict[int, str]]:
    """Runs of the commonest gait and of its reverse.

    Args:
        runs: All runs.

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
        run = runs[k]
        different = _difference(run, model)
        if different is not None:
            why[k] = different
            continue
        numbers = run.ratio.tobytes()
        if numbers in first:
            why[k] = (
                f"gives the very numbers of {runs[first[numbers]].label}: a copy is not a run of "
                "its own"
            )
            continue
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
    known = np.all(np.isfinite(ratio), axis=0)
    known &= known[::-1]
    ratio = ratio[:, known]
    unit: ComplexArray = ratio / np.abs(ratio)
    turn = np.angle(unit.sum())
    phase: FloatArray = turn + np.angle(ratio * np.exp(-1j * turn))
    names = tuple(name for name, sound in zip(runs[0].names, known, strict=True) if sound)
    y = (np.log(np.abs(ratio)) + 1j * phase).astype(np.complex128)
    return names, y


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


def _unfit(run: GaitRun) -> str | None:
    if not run.names:
        return "has no gait"
    if len(run.planes) > 1:
        return "drives both planes; the reversal test is made of one wave"
    if run.wave in (None, "standing"):
        return "has no travelling wave, so there is no reverse of it"
    if not np.isfinite(run.ratio).any():
        return "has no gain and lag"
    return None


def _difference(run: GaitRun, model: GaitRun) -> str | None:
    """What makes a run another gait than the model's or its reverse; None if nothing does."""
    if run.robot != model.robot:
        return f"is of {run.robot or 'no known robot'}, {model.label} of {model.robot or 'none'}"
    if run.names != model.names:
        return f"drives other joints than {model.label}"
    if abs(run.frequency_hz - model.frequency_hz) > SAME_FREQUENCY * model.frequency_hz:
        return f"has {run.frequency_hz:.4g} Hz, {model.label} {model.frequency_hz:.4g} Hz"
    command = run.command if run.wave == model.wave else run.command[::-1]
    change = command_change(command, model.command)
    deviation = np.abs(change - 1)
    worst = int(np.argmax(deviation))
    if deviation[worst] <= SAME_COMMAND:
        return None
    joint = run.names[worst if run.wave == model.wave else -1 - worst]
    percent = formats.number(100 * (float(np.abs(change[worst])) - 1), 1)
    degrees = formats.number(float(np.degrees(np.angle(change[worst]))), 1)
    return (
        f"commands another gait than {model.label}: at {joint} the amplitude is {percent} % and "
        f"the phase {degrees} degrees off"
    )
