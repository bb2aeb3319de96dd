"""Which runs an experiment needs, as deviations of the commands from a gait.

Runs that make the coupling of a chain without contact identifiable: lag sweep and multisine.

Without contact, at small amplitude, a = H c at every frequency. From r runs, Y = H C; H = Y C^-1 is
best estimated when C is a DFT matrix, C_jk = A exp(j 2 pi j k / m): its condition number is 1. A
lag sweep is just that: m gaits of the lags 2 pi k / m. In a multisine every frequency has such a
matrix of its own, all in the same m runs (Dobrowiecki, Schoukens & Guillaume, "Optimized excitation
signals for MIMO frequency response function measurements", IEEE Trans. Instrum. Meas. 55, 2006).
"""

from __future__ import annotations

import math
import re
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from undulog.capture import SessionView, SessionWriter
from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.common.files import part_file

from ..session.runs import HEADING
from .gait_base import BaseGait

HELD_OUT = (0.05, 0.1, 0.15)
"""Largest random phase of each held-out pattern [rad]."""


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


def phase_kicks(
    names: tuple[str, ...],
    amplitude: ComplexArray,
    repeats: int,
    *,
    kick: float,
    base_runs: int,
) -> tuple[PlannedRun, ...]:
    """Plan runs of the gait, four kicks of each joint, and held-out patterns.

    Args:
        names: Of the m driven joints.
        amplitude: Of the gait, shape (m,).
        repeats: How often all of it is run.
        kick: Of phase [rad] and of log amplitude.
        base_runs: Runs without a kick in all, at least one a repeat.

    Returns:
        4 m + 3 runs and those without a kick a repeat, in random order, so that warming up looks
        like no kick but like scatter.
    """
    random = np.random.default_rng(1)
    runs: list[PlannedRun] = []
    kinds = ("phase", kick * 1j), ("amplitude", kick)
    signs = (1, "up"), (-1, "down")
    for _ in range(repeats):
        once = [PlannedRun("base", amplitude, {"kind": "base"})] * math.ceil(base_runs / repeats)
        for (joint, name), (kind, step), (sign, word) in product(enumerate(names), kinds, signs):
            off = np.zeros(len(names), dtype=np.complex128)
            off[joint] = sign * step
            kicked = (amplitude * np.exp(off)).astype(np.complex128)
            facts = {"kind": kind, "joint": name, "sign": f"{sign:+d}"}
            once.append(PlannedRun(f"{name}-{kind}-{word}", kicked, facts))
        for size in HELD_OUT:
            turned = amplitude * np.exp(1j * random.uniform(-size, size, len(names)))
            once.append(PlannedRun("held-out", turned.astype(np.complex128), {"kind": "held-out"}))
        runs += [once[k] for k in random.permutation(len(once))]
    return tuple(runs)


def reversal(amplitude: ComplexArray, each: int = 6) -> tuple[PlannedRun, ...]:
    """Plan runs of a wave and of its reverse, the robot turned by half a turn in half of each.

    A tilted floor then cancels between runs that are each other's mirror image: the wave at one
    heading and its reverse at the other.

    Args:
        amplitude: Of the gait, head to tail, shape (m,).
        each: Runs each way.

    Returns:
        Twice as many runs, the heading among their facts. Four make a block, in which the two
        runs of a mirror image follow each other; the next block swaps the waves, so that warming
        up looks like neither direction nor heading, and the robot is turned every second run.
    """
    ways = (("as-recorded", amplitude), ("reversed", amplitude[::-1]))
    runs: list[PlannedRun] = []
    for k in range(2 * each):
        way, own = ways[(k + k // 4) % 2]
        turned = k % 4 in (1, 2)
        facts = {"kind": way, HEADING: f"{math.pi if turned else 0.0:.6f}"}
        runs.append(PlannedRun(f"{way}-{180 if turned else 0}", own, facts))
    return tuple(runs)


def lag_sweep(m: int, amplitude: float, repeats: int) -> tuple[PlannedRun, ...]:
    """Plan as many gaits as there are joints, of the lags 2 pi k / m.

    Args:
        amplitude: Of every command [rad].
        repeats: How often all of it is run.

    Returns:
        m runs a repeat, in random order so that warming up looks like no lag.
    """
    random = np.random.default_rng(1)
    order = [k for _ in range(repeats) for k in random.permutation(m).tolist()]
    return tuple(
        PlannedRun(
            f"lag{k:02d}",
            amplitude * dft(m)[k],
            {"kind": "lag", "lag_rad": f"{2 * np.pi * k / m:.6f}"},
        )
        for k in order
    )


def multisine(m: int, amplitude: float, omega: FloatArray, repeats: int) -> tuple[PlannedRun, ...]:
    """Plan m runs of all joints at all tones, with the phases of a DFT matrix over the runs.

    Args:
        amplitude: Of the first tone of every command [rad]; the others fall as 1 / omega^2, so
            that all of them need about the same torque, and none shakes the chain out of its
            linear range.
        omega: Angular frequencies of the tones, the gait's first [rad/s], shape (L,).
        repeats: How often all of it is run.

    Returns:
        m runs a repeat, in random order.
    """
    random = np.random.default_rng(1)
    phase = np.exp(1j * random.uniform(-np.pi, np.pi, omega.size))
    strength = phase * (omega[0] / omega) ** 2
    runs: list[PlannedRun] = []
    for _ in range(repeats):
        for k in random.permutation(m).tolist():
            each = [(amplitude * one * dft(m)[k]).astype(np.complex128) for one in strength]
            more = tuple(Tone(float(w), a) for w, a in zip(omega[1:], each[1:], strict=True))
            facts = {"kind": "multisine", "experiment": str(k)}
            runs.append(PlannedRun(f"experiment{k:02d}", each[0], facts, more))
    return tuple(runs)


def tones(omega: float, count: int) -> FloatArray:
    """Return frequencies of which none is another plus a whole number of the gait's.

    In units of the gait's frequency over 2 L - 1, tone i is the line i (2 L - 1) + i: remainders
    0 .. L - 1 are all different, of either sign. So the sidebands that a nonlinearity makes of one
    tone around the gait's multiples fall on no other tone.

    Args:
        omega: Of the gait, itself the first tone [rad/s].
        count: L, at least 1.

    Returns:
        Rising [rad/s], shape (L,).
    """
    step = 2 * count - 1
    place = np.arange(count)
    return omega * ((place + 1) * step + place) / step


def period_s(omega: float, count: int) -> float:
    """Return the time after which a multisine repeats [s].

    Args:
        omega: Of the gait [rad/s].

    Returns:
        2 L - 1 periods of the gait.
    """
    return (2 * count - 1) * 2 * np.pi / omega


def dft(m: int) -> ComplexArray:
    """Return exp(j 2 pi j k / m), row k = run, column j = joint; shape (m, m)."""
    place = np.arange(m)
    return np.exp(2j * np.pi / m * place[:, None] * place[None, :]).astype(np.complex128)


RATE_HZ = 100
RAMP_S = 2.0
"""Time over which the amplitude grows from zero, if the settling leaves as much."""

_LONGEST_STEM = 80
_TONES_AT_ONCE = 16


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
    known = [k for k in base.driven if base.names[k] in joints]
    for run in runs:
        values = commands(base, run, t_s, ramp_s)
        rates = np.abs(np.diff(values, axis=0)).max(axis=0, initial=0.0) * RATE_HZ
        for k in known:
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
