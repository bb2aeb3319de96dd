"""One session of a comparison: facts, estimates with variances, mean cycles.

A mean cycle goes by gait phase, the phase that the commands define.
Phase 0 is the crest of the fundamental of the first compared joint's command, in every session, so
cycles are laid over each other by what the controller meant and not by the clock. Without commands
it is the crest of that joint's own motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.untrusted_text import read_toml

from ..estimators.harmonic import HarmonicFit
from ..estimators.series import GAP_FACTOR, Series
from ..parts.body.oscillation import MotionFit
from ..parts.body.travel import body_steps, cost_of_transport, mean_of_cycles, speed
from ..parts.energy.measure import in_all
from ..results.analysis import Analysis
from ..results.comparison import BODY, MetadataChange
from ..session.analyse import measure_session
from ..session.measurement import SessionMeasurement
from ..session.parts import UNCOMPARED
from ..session.runs import GaitRun, gait_run
from ..signals.stretch import Options
from ..signals.windows import Span
from .quantities import Key, Known, PeriodicMotion, Quantities, from_runs, motion_of
from .tracking import MeanCommand, mean_commands, offset_estimates, tracking_estimates

PHASES = 72
"""Phases of a mean cycle, every 5 degrees."""

_OF_THE_RUN = frozenset(
    {
        *("session_id", "epoch_ns", "seed", "scenario", "source_session"),
        *("driven.by", "driven.session_id", "planned_duration_s"),
    }
)
"""Facts that name a run rather than describe how it was made."""

_TEXTS = frozenset({"name", "description", "serial", "seed", "epoch_s", "robot"})
"""Keys of an attached file without an effect, or that the metadata repeats."""

_FILES = ("robot.toml", "scenario.toml", "plan.toml", "calibration.toml")
_ORDER = ("robot", *_FILES, "session")


def phases_rad() -> FloatArray:
    """Return the phases of a mean cycle.

    Returns:
        From 0 up to 2 pi, not included [rad], shape (``PHASES``,).
    """
    return 2 * np.pi * np.arange(PHASES) / PHASES


def cycles_by_phase(
    series: Series,
    fit: HarmonicFit,
    channel: int,
    *,
    zero_rad: float,
    start_s: float,
    stop_s: float,
) -> FloatArray:
    """Cut a response into its whole cycles.

    What the harmonic fit leaves is interpolated linearly between samples, and the fit added again:
    so nothing of the gait itself is lost between samples.

    Args:
        fit: The fit that holds it.
        channel: Its index in the fit.
        zero_rad: Phase of the reference command's fundamental at t = 0 [rad].
        start_s: Cycles begin here or later [s].
        stop_s: And end here or earlier [s].

    Returns:
        Values [rad] of c whole cycles without gaps, shape (c, ``PHASES``).
    """
    cycle_s = 2 * np.pi / fit.omega
    first = -zero_rad / fit.omega
    first += np.ceil((start_s - first) / cycle_s - 1e-6) * cycle_s
    starts = first + cycle_s * np.arange(max(0, int(np.floor((stop_s - first) / cycle_s + 1e-6))))
    times = starts[:, None] + cycle_s * np.arange(PHASES) / PHASES
    rest = series.values - fit.predict(channel, series.t_s)
    left = Series(series.name, series.t_s, rest).at(times.ravel()).reshape(times.shape)
    cut = fit.predict(channel, times) + left
    return cut[_whole(series, starts, starts + cycle_s)]


def _whole(series: Series, start_s: FloatArray, stop_s: FloatArray) -> BoolArray:
    """Return which of c cycles samples cover without a gap, shape (c,)."""
    first, last = series.rows_from(start_s), series.rows_from(stop_s) - 1
    whole = last > first
    i, j, t_s, longest = first[whole], last[whole], series.t_s, GAP_FACTOR * series.period_s
    gaps = np.append(0, np.cumsum(np.diff(t_s) > longest))  # before each sample
    whole[whole] = (
        (t_s[i] - start_s[whole] <= longest)
        & (stop_s[whole] - t_s[j] <= longest)
        & (gaps[i] == gaps[j])
    )
    return whole


def facts_of(session: SessionView) -> dict[str, str]:
    """Read the facts that a session records of itself.

    Returns:
        Dotted names to text: of the attached robot, scenario and plan (e.g.
        ``scenario.toml: servo_of.joint03.stall_torque``), and of the metadata.
    """
    facts = {"robot": "" if session.robot is None else session.robot.name}
    for file in _FILES:
        if (data := session.attachments.get(file)) is None:
            continue
        try:
            table = read_toml(data.decode())
        except ValueError:
            facts[f"{file}: text"] = repr(data)
            continue
        kept = {key: value for key, value in table.items() if key not in _TEXTS}
        facts |= {f"{file}: {key}": text for key, text in _flat(kept).items()}
    recorded = session.metadata.get("undulog", {}).items()
    return facts | {f"session: {key}": value for key, value in recorded if key not in _OF_THE_RUN}


def one_robot(facts: Sequence[Mapping[str, str]]) -> bool:
    """Return whether sessions may be of one robot: none has another name or serial number.

    Args:
        facts: Of each session.
    """
    keys = ("robot", "session: serial")
    return all(len({fact[key] for fact in facts if fact.get(key)}) <= 1 for key in keys)


def changes(
    a: Sequence[Mapping[str, str]], b: Sequence[Mapping[str, str]]
) -> tuple[MetadataChange, ...]:
    """List the facts that differ between the sides.

    Args:
        a: Facts of each session of side A.
        b: Of each session of side B.

    Returns:
        Robot first, then scenario, then versions; values that only one side has are None on the
        other.
    """
    names = list(dict.fromkeys(name for facts in (*a, *b) for name in facts))
    changed = [
        MetadataChange(name, *sides)
        for name in names
        if (sides := (_recorded_value(a, name), _recorded_value(b, name)))[0] != sides[1]
    ]
    return tuple(sorted(changed, key=lambda change: _ORDER.index(change.name.partition(":")[0])))


def _recorded_value(side: Sequence[Mapping[str, str]], name: str) -> str | None:
    values = sorted({facts[name] for facts in side if name in facts})
    return ", ".join(values) if values else None


def _flat(value: Any, before: str = "") -> dict[str, str]:
    """Flatten a TOML table to dotted names; entries of a list go by their name or index."""
    parts: dict[str, Any] = {}
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        parts = {f"{before}.{key}" if before else key: part for key, part in table.items()}
    elif isinstance(value, list):
        for k, part in enumerate(cast("list[Any]", value)):
            if isinstance(part, dict):
                name = cast("dict[str, Any]", part).get("name", k)
                parts[f"{before}[{name}]"] = part
    if not parts:
        return {} if value == {} else {before: _text(value)}
    flat: dict[str, str] = {}
    for key, part in parts.items():
        flat |= _flat(part, key)
    return flat


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class ComparedSession:
    """One session.

    Attributes:
        facts: Recorded facts, by their dotted names.
        estimates: ln gain [1], lag [rad] and offset [rad] of the joints, of those whose commands
            are no gait ln gain, delay [s] and offset; E_abs per cycle [J]; speed [m/s] and cost of
            transport of the body.
        cycles: Mean cycle of each joint by the phase of the first command of its group, or of the
            first joint's own motion where no commands were logged [rad].
        offsets: Mean of each joint's position less that of its command [rad].
        motion: The periodic motion, where no commands were logged.
        commands: Those that offsets were measured at, by joint.
    """

    analysis: Analysis
    run: GaitRun
    facts: Mapping[str, str]
    estimates: Mapping[Key, Known]
    cycles: Mapping[str, Quantities]
    offsets: Mapping[str, float]
    motion: PeriodicMotion | None = None
    commands: Mapping[str, MeanCommand] = field(default_factory=dict[str, MeanCommand])

    @property
    def commanded(self) -> bool:
        """Whether commands were logged."""
        return self.analysis.free_motion is None


def see(session: SessionView, options: Options, warn: Warn) -> ComparedSession:
    """Measure the quantities of a session that are compared.

    Args:
        warn: Receives a sentence for each missing quantity.

    Raises:
        MissingChannelError: If the session has neither commands nor responses.
        DataError: If they hold no samples.
        UsageError: If the options leave nothing of the session.
    """
    measured = measure_session(session, options, without=UNCOMPARED)
    analysis = measured.analysis
    run = gait_run(Path(analysis.session.path).name, session.robot, analysis, measured.gait)
    estimates = _responses(measured, run) | _energies(measured)
    estimates |= offset_estimates(measured.gait_offsets) | tracking_estimates(analysis.tracking)
    powers = [energies.mechanical for energies in measured.energies.values()]
    total = in_all([None if power is None else power.abs_j for power in powers])
    steps = None
    if measured.gait is not None:
        steps = body_steps(session, measured.responses, measured.span, warn)
    if steps is not None:
        moved = {"speed": speed(steps)}
        if total is not None:
            moved["cost_of_transport"] = cost_of_transport(steps, total)
        for quantity, estimate in moved.items():
            if estimate is None:
                warn(f"no {quantity.replace('_', ' ')}: it hardly gets anywhere")
            else:
                estimates[quantity, BODY] = estimate
    offsets = {
        name: float(np.median(offset)) for name, offset in measured.offsets.items() if offset.size
    }
    moved = measured.motion
    motion = None if moved is None else motion_of(run.label, session.robot, moved)
    cycles = _cycles(measured, run) if moved is None else _cycles_of_motion(moved, measured.span)
    commands = mean_commands(measured.gait_offsets, analysis.tracking)
    facts = facts_of(session)
    return ComparedSession(analysis, run, facts, estimates, cycles, offsets, motion, commands)


def turned(cycle: Quantities, by_rad: float) -> Quantities:
    """Turn a mean cycle to another joint's phase.

    Args:
        cycle: At evenly spaced phases, shape (p,).
        by_rad: The new phase 0 lies this far behind the old one [rad].

    Returns:
        The same periodic function, shifted (exactly, by its Fourier coefficients).
    """
    if by_rad == 0:
        return cycle
    coefficients = np.fft.rfft(cycle.value)
    order = np.arange(coefficients.size)
    value = np.fft.irfft(coefficients * np.exp(1j * order * by_rad), cycle.value.size)
    phase = phases_rad()
    variance = np.interp(phase + by_rad, phase, cycle.variance, period=2 * np.pi)
    return Quantities(value.astype(np.float64), variance, cycle.dof)


def _responses(measured: SessionMeasurement, run: GaitRun) -> dict[Key, Known]:
    gait = measured.gait
    estimates: dict[Key, Known] = {}
    if gait is None:
        return estimates
    sound = {n for n, ratio in zip(run.names, run.ratio, strict=True) if np.isfinite(ratio)}
    for group in gait.groups:
        response = group.response
        if response is None:
            continue
        for k, name in enumerate(group.answered):
            if name in sound:
                dof = float(response.dof[k])
                gain, lag = float(np.log(response.gain[k])), float(response.lag_rad[k])
                estimates["gain", name] = gain, float(response.log_gain_variance[k]), dof
                estimates["lag", name] = lag, float(response.lag_variance[k]), dof
    return estimates


def _energies(measured: SessionMeasurement) -> dict[Key, Known]:
    estimates: dict[Key, Known] = {}
    for name, energies in measured.energies.items():
        power = energies.mechanical
        if power is not None and (mean := mean_of_cycles(power.abs_j)) is not None:
            estimates["energy_abs", name] = mean
    return estimates


def _cycles(measured: SessionMeasurement, run: GaitRun) -> dict[str, Quantities]:
    gait, span = measured.gait, measured.span
    quantities: dict[str, Quantities] = {}
    if gait is None or not run.names:
        return quantities
    for group, members in zip(gait.groups, run.by_group, strict=True):
        for k, name in enumerate(group.answered):
            at, first = len(group.driven) + k, complex(run.command[members[0]])
            quantities |= _mean_cycle(measured.responses[name], group.fit, at, first, span)
    return quantities


def _cycles_of_motion(moved: MotionFit, span: Span) -> dict[str, Quantities]:
    quantities: dict[str, Quantities] = {}
    for row, series in enumerate(moved.series):
        quantities |= _mean_cycle(series, moved.fit, row, complex(moved.fit.fundamental[0]), span)
    return quantities


def _mean_cycle(
    series: Series, fit: HarmonicFit, channel: int, reference: complex, span: Span
) -> dict[str, Quantities]:
    """Return the mean cycle by the phase of a reference, by name; empty without two cycles."""
    zero_rad = float(np.angle(reference))
    window = {"zero_rad": zero_rad, "start_s": span.start_s, "stop_s": span.stop_s}
    cut = cycles_by_phase(series, fit, channel, **window)
    return {series.name: from_runs(cut)} if len(cut) > 1 else {}
