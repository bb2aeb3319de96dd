"""Planned runs as sessions of commands."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from undulog.capture import SessionView, SessionWriter
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.common.files import part_file

from .designs import PlannedRun
from .gait_base import BaseGait

RATE_HZ = 100
RAMP_S = 2.0
"""Time over which the amplitude grows from zero, if the settling leaves as much."""

_LONGEST_STEM = 80


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
        plan: Name of the design.
        base: The gait.
        runs: The runs.
        like: The session the gait is of; its robot, and the twin's scenario, go along.
        folder: Where to; made if it isn't there.
        settle_s: Time before what is to be measured [s].
        measure_s: Length of what is to be measured [s].
        facts: More for the metadata record of every run.

    Returns:
        The files.

    Raises:
        UsageError: If a command would leave the robot's joint limits, or a file is there already;
            nothing is written then.
        LogWriteError: If the folder or a file can't be written.
    """
    _check_limits(base, runs, like)
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
    length_ns = round((settle_s + measure_s) * 1e9)
    t_ns = np.arange(0, length_ns + 1, 1_000_000_000 // RATE_HZ, dtype=np.int64)
    t_s: FloatArray = t_ns.astype(np.float64) * 1e-9
    for k, (file, run) in enumerate(zip(files, runs, strict=True)):
        start_ns = epoch_ns + k * length_ns
        values = commands(base, run, t_s, min(RAMP_S, settle_s))
        with (
            part_file(file) as part,
            SessionWriter(
                part,
                session_id=uuid.uuid4().hex,
                epoch_ns=start_ns,
                robot=like.robot,
                metadata={"settle_s": f"{settle_s:g}"},
                force=True,
            ) as writer,
        ):
            told = {"plan": plan, "plan_id": plan_id, "run": str(k), "like": like.session_id}
            told |= {"settle_s": f"{settle_s:g}", "measure_s": f"{measure_s:g}"}
            writer.note("undulog.plan", told | dict(facts or {}) | run.facts)
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
    """Commands of all joints.

    Args:
        base: The gait.
        run: The run.
        t_s: Times [s], shape (k,).
        ramp_s: Time over which the amplitude grows from zero without a corner [s].

    Returns:
        Angles [rad], shape (k, n).
    """
    x = np.clip(t_s / ramp_s, 0.0, 1.0) if ramp_s > 0 else np.ones_like(t_s)
    grown = x * x * (3 - 2 * x)
    values = np.tile(base.offset, (t_s.size, 1))
    for tone in run.tones(base.omega):
        wave = np.real(np.exp(1j * tone.omega * t_s)[:, None] * tone.amplitude[None, :])
        values[:, list(base.driven)] += grown[:, None] * wave
    return values


def _check_limits(base: BaseGait, runs: Sequence[PlannedRun], like: SessionView) -> None:
    if like.robot is None:
        return
    joints = {joint.name: joint for joint in like.robot.joints}
    for run in runs:
        largest = np.sum([np.abs(tone.amplitude) for tone in run.tones(base.omega)], axis=0)
        for k, amplitude in zip(base.driven, largest, strict=True):
            joint = joints.get(base.names[k])
            if joint is None:
                continue
            low, high = base.offset[k] - amplitude, base.offset[k] + amplitude
            if low < joint.lower or high > joint.upper:
                raise UsageError(
                    f"{like.path}: {run.label} would command {joint.name} from {low:.3f} to "
                    f"{high:.3f} rad, its limits are {joint.lower:.3f} and {joint.upper:.3f}; "
                    "record a gait of less amplitude"
                )
