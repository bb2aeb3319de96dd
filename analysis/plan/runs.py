"""Runs of a plan: sines around the gait of a recorded session, written as sessions of commands."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from undulog.capture import SessionView, SessionWriter
from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.common.files import part_file
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC

from ..common.answer import percent
from ..common.remarks import Remarks
from ..session.analyse import measure_session
from ..session.parts import BEYOND_THE_GAIT
from ..signals.columns import read_columns

PURE = 0.01
"""Harmonics of a command above this share of its fundamental are no sine any more."""

RATE_HZ = 100
RAMP_S = 2.0
"""Time over which the amplitude grows from zero, if the settling leaves as much."""

_LISTED = 12
_LONGEST_STEM = 80
_TONES_AT_ONCE = 16


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
    gait = measure_session(session, without=BEYOND_THE_GAIT).gait
    if gait is None or not gait.driven:
        raise UsageError(f"{session.path}: it commands no steady gait; name a session that does")
    if gait.others:
        frequencies = ", ".join(f"{group.fit.frequency_hz:.4g} Hz" for group in gait.groups)
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
        name: (float(np.nanmin(command.values)), float(np.nanmax(command.values)))
        for name, command in columns.command.items()
        if np.isfinite(command.values).any()
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


@dataclass(frozen=True)
class Tone:
    """A sine at a frequency of its own, in all driven joints.

    Attributes:
        omega: Angular frequency [rad/s].
        amplitude: Complex amplitudes of the driven joints' commands [rad], shape (m,).
    """

    omega: float
    amplitude: ComplexArray


@dataclass(frozen=True)
class PlannedRun:
    """One run's commands.

    Attributes:
        amplitude: Complex amplitudes of the driven joints' commands at the gait's frequency [rad],
            shape (m,).
        facts: What it is, for its metadata record.
    """

    label: str
    amplitude: ComplexArray
    facts: dict[str, str] = field(default_factory=dict[str, str])
    more: tuple[Tone, ...] = ()

    def tones(self, omega: float) -> tuple[Tone, ...]:
        """Return frequencies of which none is another plus a whole number of the gait's.

        Args:
            omega: The gait's angular frequency [rad/s].

        Returns:
            The tone at the gait's frequency, then the others.
        """
        return (Tone(omega, self.amplitude), *self.more)


def write_plan(
    plan: str,
    base: BaseGait,
    runs: Sequence[PlannedRun],
    like: SessionView,
    folder: Path,
    *,
    settle_s: float,
    measure_s: float,
    facts: Mapping[str, str] | None = None,
) -> tuple[Path, ...]:
    """Write each run's commands to a session of its own.

    Args:
        like: The session the gait is of; its robot, and the twin's scenario and kernels, go along.
        folder: Where to; made if it isn't there.
        settle_s: Time before what is to be measured [s].
        measure_s: Length of what is to be measured [s].
        facts: More for the metadata record of every run.

    Raises:
        UsageError: If a command would leave the robot's joint limits or is faster than its joint,
            or a file is there already; nothing is written then.
        LogWriteError: If the folder or a file can't be written.
    """
    length_ns = round((settle_s + measure_s) * 1e9)
    t_ns = np.arange(0, length_ns + 1, 1_000_000_000 // RATE_HZ, dtype=np.int64)
    t_s: FloatArray = t_ns.astype(np.float64) * 1e-9
    ramp_s = min(RAMP_S, settle_s)
    _check_limits(base, runs, like, t_s, ramp_s)
    files = [folder / f"run{k:03d}-{_file_stem(run.label)}.mcap" for k, run in enumerate(runs)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = [file for file in files if file.exists()]
    except OSError as error:
        reason = error.strerror or error
        raise LogWriteError(folder, f"no folder for the plan can be made: {reason}") from error
    if there:
        raise UsageError(f"{there[0]} exists already; name another folder")
    plan_id, epoch_ns = uuid.uuid4().hex, time.time_ns()
    twin = like.metadata.get("undulog", {})
    metadata = {"settle_s": f"{settle_s:g}"} | {k: twin[k] for k in ("kernels",) if k in twin}
    for k, (file, run) in enumerate(zip(files, runs, strict=True)):
        start_ns = epoch_ns + k * length_ns
        values = commands(base, run, t_s, ramp_s)
        with (
            part_file(file) as part,
            SessionWriter(
                part,
                session_id=uuid.uuid4().hex,
                epoch_ns=start_ns,
                robot=like.robot,
                metadata=metadata,
                force=True,
            ) as writer,
        ):
            record = {"plan": plan, "plan_id": plan_id, "run": str(k), "like": like.session_id}
            record |= {"settle_s": f"{settle_s:g}", "measure_s": f"{measure_s:g}"}
            writer.note("undulog.plan", record | dict(facts or {}) | run.facts)
            if "scenario.toml" in like.attachments:
                writer.attach(
                    "scenario.toml", "application/toml", like.attachments["scenario.toml"]
                )
            channel = writer.joint_state("/joint_commands", base.names, unit="rad")
            for at_ns, row in zip(t_ns.tolist(), values, strict=True):
                channel.write(start_ns + at_ns, row)
    return tuple(files)


def _file_stem(label: str) -> str:
    """Replace what has a meaning in paths, since joint names come from any log."""
    return re.sub(r"[^\w.+-]", "_", label)[:_LONGEST_STEM]


def commands(base: BaseGait, run: PlannedRun, t_s: FloatArray, ramp_s: float) -> FloatArray:
    """Return the commands of all joints.

    Args:
        t_s: Times [s], shape (k,).
        ramp_s: Time over which the amplitude grows from zero without a corner [s].

    Returns:
        Angles [rad], shape (k, n).
    """
    x = np.clip(t_s / ramp_s, 0.0, 1.0) if ramp_s > 0 else np.ones_like(t_s)
    grown = x * x * (3 - 2 * x)
    tones = run.tones(base.omega)
    wave = np.zeros((t_s.size, len(base.driven)))
    for k in range(0, len(tones), _TONES_AT_ONCE):
        some = tones[k : k + _TONES_AT_ONCE]
        turns = np.exp(1j * np.outer(t_s, [tone.omega for tone in some]))
        wave += np.real(turns @ np.stack([tone.amplitude for tone in some]))
    values = np.tile(base.offset, (t_s.size, 1))
    values[:, list(base.driven)] += grown[:, None] * wave
    return values


def _check_limits(
    base: BaseGait, runs: Sequence[PlannedRun], like: SessionView, t_s: FloatArray, ramp_s: float
) -> None:
    """Refuse commands beyond the limits of position and rate of their joints."""
    if like.robot is None:
        return
    joints = {joint.name: joint for joint in like.robot.joints}
    highest = [joint.max_velocity for joint in like.robot.joints]
    if like.robot.safety is not None:
        highest = np.fmin(highest, like.robot.safety.values("max_rate", tuple(joints))).tolist()
    fastest = dict(zip(joints, highest, strict=True))
    described = [k for k in base.driven if base.names[k] in joints]
    for run in runs:
        values = commands(base, run, t_s, ramp_s)
        rates = np.abs(np.diff(values, axis=0)).max(axis=0, initial=0.0) * RATE_HZ
        for k in described:
            joint = joints[base.names[k]]
            low, high, rate = float(values[:, k].min()), float(values[:, k].max()), float(rates[k])
            if low < joint.lower or high > joint.upper:
                raise UsageError(
                    f"{like.path}: {run.label} would command {joint.name} from {low:.3f} to "
                    f"{high:.3f} rad, its limits are {joint.lower:.3f} and {joint.upper:.3f}; "
                    "take a smaller amplitude, or record a session whose offsets are further "
                    "from the limits"
                )
            if rate > fastest[joint.name]:
                raise UsageError(
                    f"{like.path}: {run.label} would command {joint.name} at up to {rate:.3g} "
                    f"rad/s, its limit is {fastest[joint.name]:g} rad/s; take a smaller amplitude "
                    "or a lower frequency"
                )
