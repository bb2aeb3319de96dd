"""Runs of a multisine experiment: the record of their plan, and sessions found to be such runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import DataError

from ..estimators.series import Series
from ..parts.frequency_response.excitation import REPEATED, ExcitationKind, find_excitation
from ..parts.frequency_response.measure import SAME_COMMAND
from ..parts.frequency_response.nonparametric import excited_lines, resampled
from ..response.rhythm import DRIVEN_SHARE
from ..signals.stretch import Options
from .sweep_runs import read_signals

KIND = "odd-random-phase"
"""Value of ``kind`` in the record of each run."""

MOST_LINES = 512
HIGHEST_LINE = 100_000
LONGEST_PERIOD_S = 1e4

Inputs = Literal["same", "orthogonal"]

HIGHEST = 0.25
"""Share of the sampling rate up to which lines are estimated: beyond it splines are not exact."""

LEAST_LINES = 4
"""Lines from which commands without a plan are a multisine."""

_MOST_PERIODS = 64
_STEPS = 16  # of a period, by which its end is moved
_LONG_GAP = 0.02  # of a period
_LEAST_LINE = 0.05  # of the median of the lines' amplitudes
_SAME_LINES_S = 1e-6  # relative


@dataclass(frozen=True)
class MultisineDesign:
    """What one run of a multisine experiment commands.

    Attributes:
        plan: Identifier of the experiment; empty where only the commands are known.
        period_s: After which the commands repeat [s].
        periods: Steady periods that were planned.
        lines: Excited multiples of 1 / ``period_s``, ascending.
        realisation: Number of the realisation that the run belongs to; -1 where it isn't known.
        inputs: Whether all joints have the same command.
    """

    plan: str
    period_s: float
    periods: int
    lines: tuple[int, ...]
    realisation: int
    inputs: Inputs


def planned_design(record: Mapping[str, str], where: str) -> MultisineDesign | None:
    """Read the design of a session.

    Args:
        record: Its record ``undulog.plan``; empty without.
        where: The session, for messages.

    Returns:
        None where it is of no multisine over a band.

    Raises:
        DataError: If a field of the record is missing or wrong.
    """
    if record.get("kind") != KIND:
        return None

    def number(field: str, least: float, most: float) -> float:
        text = record.get(field, "")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise DataError(
                f"{where}: {field} of its record undulog.plan is {text[:40]!r}; expected a number "
                f"from {least:g} to {most:g}"
            )
        return value

    text = record.get("lines", "")
    words = text.split(maxsplit=MOST_LINES)
    sound = len(words) <= MOST_LINES and all(w.isascii() and w.isdigit() for w in words)
    lines = tuple(int(word[:9]) for word in words) if sound else ()
    if not lines or sorted(set(lines)) != [*lines] or not 0 < lines[0] <= lines[-1] <= HIGHEST_LINE:
        raise DataError(
            f"{where}: lines of its record undulog.plan are {text[:40]!r}; expected up to "
            f"{MOST_LINES} ascending whole numbers from 1 to {HIGHEST_LINE}"
        )
    inputs = record.get("inputs", "")
    if inputs not in ("same", "orthogonal"):
        raise DataError(
            f"{where}: inputs of its record undulog.plan is {inputs[:40]!r}; expected 'same' or "
            "'orthogonal'"
        )
    return MultisineDesign(
        plan=record.get("plan_id", ""),
        period_s=number("period_s", 1e-3, LONGEST_PERIOD_S),
        periods=int(number("periods", 1, 1e6)),
        lines=lines,
        realisation=int(number("realisation", 0, 1e6)),
        inputs="same" if inputs == "same" else "orthogonal",
    )


@dataclass(frozen=True)
class MultisineRun:
    """Spectra of the steady periods of one session.

    Attributes:
        names: Driven joints, head to tail, m.
        robot: Name of the robot, or None.
        command: U at the excited lines, mean of the periods [rad], shape (m, k).
        response: Y of each period from line 0 to the highest excited one [rad], by joint, shape
            (P, n).
        impurity: Root mean square of the commands at the other lines within the band, over that
            at the excited lines.
    """

    design: MultisineDesign
    names: tuple[str, ...]
    robot: str | None
    command: ComplexArray
    response: Mapping[str, ComplexArray]
    impurity: float

    @property
    def periods(self) -> int:
        """P."""
        return len(next(iter(self.response.values())))

    @property
    def shared(self) -> bool:
        """Whether all commands are one but for sign and scale."""
        size = np.linalg.norm(self.command, axis=1)
        first = self.command[0] / size[0]
        along = np.abs(self.command.real @ first.real + self.command.imag @ first.imag)
        return bool((along / size > SAME_COMMAND).all())


@dataclass(frozen=True)
class MultisineRuns:
    """Sessions of one experiment.

    Attributes:
        index: Which of all sessions they are.
        runs: Those sessions, with the numbers of their realisations.
        why: Why other sessions are left out, by index.
    """

    index: tuple[int, ...]
    runs: tuple[MultisineRun, ...]
    why: Mapping[int, str]


def multisine_run(
    session: SessionView, options: Options, robot: str | None
) -> MultisineRun | str | None:
    """Read the periods of one session.

    Args:
        session: An open session, examined before.
        robot: Name of its robot, or None.

    Returns:
        The reason where it is of a planned multisine but can't be used; None where it is of none.

    Raises:
        DataError: If its plan's record is wrong.
    """
    record = session.metadata.get("undulog.plan", {})
    design = planned_design(record, str(session.path))
    commands, positions, _ = read_signals(session, options)
    swing = {
        name: float(np.ptp(command.values))
        for name, command in commands.items()
        if command.count > 1
    }
    least = DRIVEN_SHARE * max(swing.values(), default=0.0)
    driven = {name: commands[name] for name, size in swing.items() if size > least}
    if design is None:
        design = _commanded_design(driven)
        if design is None:
            return None
    joints = [name for name in driven if name in positions and positions[name].count > 1]
    if not joints:
        return "no driven joint has a response"
    try:
        return _spectra(design, driven, {name: positions[name] for name in joints}, robot)
    except DataError as error:
        return str(error)


def _commanded_design(driven: Mapping[str, Series]) -> MultisineDesign | None:
    """Find period and lines of a session without a plan, by its first driven joint."""
    command = next(iter(driven.values()), None)
    excitation = None if command is None else find_excitation(command)
    if command is None or excitation is None or excitation.kind is not ExcitationKind.PERIODIC:
        return None
    period_s = excitation.period_s
    if not period_s < LONGEST_PERIOD_S:
        return None
    length = min(round(period_s / command.period_s), command.count)
    t_s = command.t_s[-1] - np.arange(length)[::-1] * period_s / length
    lines = excited_lines(np.fft.rfft(resampled(command, t_s))[None])
    if not LEAST_LINES <= lines.size <= MOST_LINES or lines[-1] > min(HIGHEST_LINE, length // 4):
        return None
    return MultisineDesign("", period_s, _MOST_PERIODS, tuple(lines.tolist()), -1, "same")


def _spectra(
    design: MultisineDesign,
    commands: Mapping[str, Series],
    responses: Mapping[str, Series],
    robot: str | None,
) -> MultisineRun:
    """Transform the last steady periods.

    Raises:
        DataError: If there are none.
    """
    every = [*commands.values(), *responses.values()]
    start_s, stop_s = (
        max(channel.t_s[0] for channel in every),
        min(channel.t_s[-1] for channel in every),
    )
    T = design.period_s
    step_s = max(channel.period_s for channel in every)
    if stop_s - start_s + step_s < T:
        raise DataError(
            f"holds {max(stop_s - start_s, 0.0):.4g} s of steady commands and responses, less than "
            f"a period of {T:g} s"
        )
    length = min(round(T / step_s), *(channel.count for channel in every))
    if design.lines[-1] > HIGHEST * length:
        raise DataError(
            f"is sampled every {step_s:.3g} s, too slowly for its lines up to "
            f"{design.lines[-1] / T:.3g} Hz"
        )
    end_s, periods = _steady_periods(design, [*commands.values()], (start_s, stop_s), length)
    t_s = end_s - np.arange(periods * length, 0, -1) * T / length
    for channel in every:
        inside = channel.between(t_s[0], t_s[-1])
        if inside.count < 2 or np.diff(inside.t_s).max() > max(_LONG_GAP * T, 4 * step_s):
            raise DataError(f"has a gap at {channel.name} within its steady periods")

    def spectrum(series: Series) -> ComplexArray:
        values = resampled(series, t_s).reshape(periods, length)
        return (np.fft.rfft(values, axis=1)[:, : design.lines[-1] + 1] / length).astype(
            np.complex128
        )

    u = np.stack([spectrum(command).mean(axis=0) for command in commands.values()])
    lines: IntArray = np.array(design.lines)
    command = u[:, lines]
    size = np.abs(command)
    if (size.min(axis=1) < _LEAST_LINE * np.median(size, axis=1)).any():
        raise DataError("does not command all the lines of its plan")
    others = np.setdiff1d(np.arange(int(lines[0]), int(lines[-1])), lines)
    impurity = np.sqrt(np.mean(np.abs(u[:, others]) ** 2) / np.mean(size**2)) if others.size else 0
    return MultisineRun(
        design,
        tuple(commands),
        robot,
        command,
        {name: spectrum(response) for name, response in responses.items()},
        float(impurity),
    )


def _steady_periods(
    design: MultisineDesign, commands: Sequence[Series], limits: tuple[float, float], length: int
) -> tuple[float, int]:
    """Find the last time at which most periods end that repeat one another.

    Returns:
        That time [s], and how many.
    """
    (start_s, stop_s), T = limits, design.period_s
    count = int((stop_s - start_s) / T * length + 1e-6) + 1
    t_s = stop_s - np.arange(count)[::-1] * T / length
    values = np.stack([resampled(command, t_s) for command in commands])
    power = float(np.sum(np.var(values, axis=1)))
    differ = np.sum((values[:, length:] - values[:, :-length]) ** 2, axis=0)
    total: FloatArray = np.concatenate([[0.0], np.cumsum(differ)])
    most = min(design.periods, t_s.size // length, _MOST_PERIODS)
    for periods in range(most, 1, -1):
        window = (periods - 1) * length
        for end in range(differ.size, window - 1, -max(length // _STEPS, 1)):
            if total[end] - total[end - window] <= 2 * REPEATED * power * window:
                return float(t_s[end - 1 + length]) + T / length, periods
    return float(t_s[-1]) + T / length, 1


def find_multisine(runs: Sequence[MultisineRun | str | None]) -> MultisineRuns | None:
    """Find the largest experiment among sessions.

    Returns:
        None where fewer than two sessions are of one.
    """
    why = {k: reason for k, reason in enumerate(runs) if isinstance(reason, str)}
    multisines = [(k, run) for k, run in enumerate(runs) if isinstance(run, MultisineRun)]
    best: list[tuple[int, MultisineRun]] = []
    for _, model in multisines:
        alike = [(k, run) for k, run in multisines if _alike(run, model)]
        best = alike if len(alike) > len(best) else best
    if len(best) < 2:
        return None
    model = best[0][1]
    seen: dict[bytes, int] = {}
    chosen: dict[int, MultisineRun] = {}
    for k, run in best:
        numbers = b"".join(spectrum.tobytes() for spectrum in run.response.values())
        if numbers in seen:
            why[k] = "is a copy of another session's numbers: a copy is not a run of its own"
            continue
        seen[numbers] = k
        chosen[k] = run
    if len(chosen) < 2:
        return None
    for k, run in multisines:
        if k not in chosen and k not in why:
            differs = (
                "names another experiment"
                if run.design.plan != model.design.plan
                else ("has another robot, other driven joints, another period or other lines")
            )
            why[k] = f"{differs} than the others"
    for k, run in enumerate(runs):
        if run is None:
            why[k] = "commands no multisine of this experiment"
    return MultisineRuns(tuple(chosen), _numbered([*chosen.values()]), why)


def _alike(run: MultisineRun, model: MultisineRun) -> bool:
    a, b = run.design, model.design
    return (
        (a.plan, a.lines, a.inputs) == (b.plan, b.lines, b.inputs)
        and (run.names, run.robot) == (model.names, model.robot)
        and abs(a.period_s - b.period_s) <= _SAME_LINES_S * b.period_s
    )


def _numbered(runs: Sequence[MultisineRun]) -> tuple[MultisineRun, ...]:
    """Number the realisations of runs without a plan by their phases, whenever they started."""
    if runs[0].design.realisation >= 0:
        return tuple(runs)
    first: list[MultisineRun] = []
    numbered: list[MultisineRun] = []
    for run in runs:
        number = next(
            (k for k, earlier in enumerate(first) if _same_phases(earlier, run)), len(first)
        )
        if number == len(first):
            first.append(run)
        numbered.append(replace(run, design=replace(run.design, realisation=number)))
    return tuple(numbered)


def _same_phases(run: MultisineRun, other: MultisineRun) -> bool:
    """Return whether two commands are one but for a shift of time."""
    lines: IntArray = np.array(run.design.lines)
    spectrum = np.zeros(32 * int(lines[-1]), dtype=np.complex128)
    spectrum[lines] = np.sum(run.command * other.command.conj(), axis=0)
    correlation = float(np.fft.ifft(spectrum).real.max()) * spectrum.size
    norm = float(np.linalg.norm(run.command) * np.linalg.norm(other.command))
    return correlation > SAME_COMMAND * norm
