"""Find sessions that are runs of one lag sweep or multisine, from their commands.

They drive the same joints at the same frequencies, and at a frequency their commands, one column a
run, make a matrix C of full rank and small condition number: that is what H = Y C^-1 needs, and
neither repeats of a gait nor kicks around one have it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import fdtrc

from undulog.capture import Session, SessionView
from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import DataError
from undulog.capture.log.read.sample_times import Signal
from undulog.capture.robot.model import Robot
from undulog.capture.robot.run import TwinRun

from ..common.remarks import Remarks
from ..estimators.series import Series, clean
from ..response.changes import DRIFT_PER_CYCLE
from ..response.fitting import GaitFit
from ..response.rhythm import DRIVEN_SHARE, NYQUIST_SHARE
from ..session.runs import SAME_FREQUENCY
from ..signals.columns import read_columns
from ..signals.stretch import Options, choose_stretch
from .tones import Beside, Phasors, ToneFit, common_step, find_tones, fit_tones

MOST_CONDITION = 10.0
"""Commands with a larger condition number make no sweep; a DFT matrix has 1."""

_PURE = 1e-5
"""Share of the commands' variance that a single tone may leave unexplained."""

_ALIKE = 1.5
"""Runs whose commands are larger or smaller by this factor are of another amplitude."""

_ORTHOGONAL = 0.1

_PERIODS = 1.5
"""Periods of a multisine in a record from which lines beside its tones are resolved."""

_MOST_LINES = 60

_CHANCE_OF_DRIFT = 5e-3
"""Chance of a warning about a settled run."""


@dataclass(frozen=True)
class CommandTones:
    """Commands of one session.

    Attributes:
        names: Driven joints, head to tail, m.
        robot: Name of the robot, or None.
        omega: Angular frequencies [rad/s], shape (L,).
        command: Complex amplitudes [rad], shape (m, L).
    """

    names: tuple[str, ...]
    robot: str | None
    omega: FloatArray
    command: ComplexArray


@dataclass(frozen=True)
class Sweep:
    """Sessions that are runs of one sweep.

    Attributes:
        index: Which of all sessions they are, r.
        names: Driven joints, head to tail, m.
        tones: Which of the commanded lines C is regular at; the others are a gait underneath.
        lines: How many lines are commanded; one is a lag sweep, more a multisine.
        lacking: Runs that are missing for C to have full rank.
    """

    index: tuple[int, ...]
    names: tuple[str, ...]
    tones: tuple[int, ...]
    lines: int
    lacking: int = 0


Signals = tuple[dict[str, Series], dict[str, Series], dict[str, Series]]
"""Commands, positions and efforts by joint name, in seconds from the window's middle."""


def read_signals(session: SessionView, options: Options) -> Signals:
    """Read the signals of the analysed window.

    Args:
        session: An open session, examined before: its warnings are collected already.
    """
    unused = Remarks()
    columns = read_columns(session, options.command_topic, options.response_topic, unused)
    stretch = choose_stretch(session, columns, options, unused).stretch
    origin_ns = stretch.start_ns + (stretch.stop_ns - stretch.start_ns) // 2
    half_s = stretch.duration_s / 2

    def part(signals: Mapping[str, Signal]) -> dict[str, Series]:
        recorded = [(name, signals[name]) for name in columns.names if name in signals]
        cleaned = {
            name: clean(name, signal.t_ns, signal.values, origin_ns) for name, signal in recorded
        }
        return {name: series.between(-half_s, half_s) for name, series in cleaned.items()}

    return part(columns.command), part(columns.position), part(columns.effort)


def command_tones(
    session: SessionView, options: Options, gait: GaitFit | None, robot: str | None
) -> CommandTones | None:
    """Find the tones of a session's commands.

    Args:
        gait: The fitted gait, or None.
        robot: Name of the robot, or None.

    Returns:
        The gait's frequency alone, or the tones of a multisine; None of anything else.
    """
    if gait is not None and gait.driven and not gait.others:
        m = len(gait.driven)
        if float(gait.fit.rss[:m].sum() / gait.fit.total[:m].sum()) < _PURE:
            omega = np.array([gait.fit.omega])
            return CommandTones(gait.driven, robot, omega, gait.fit.fundamental[:m, None])
    commands = [
        read_signal
        for read_signal in read_signals(session, options)[0].values()
        if read_signal.count > 64
    ]
    tones = find_tones(commands)
    if tones is None:
        return None
    amplitude = fit_tones(commands, tones, np.zeros(0)).amplitude
    size = np.abs(amplitude).max(axis=1)
    driven: BoolArray = size > DRIVEN_SHARE * size.max()
    names = tuple(command.name for command, moves in zip(commands, driven, strict=True) if moves)
    return CommandTones(names, robot, tones, amplitude[driven])


def find_sweep(sessions: Sequence[CommandTones | None]) -> Sweep | None:
    """Find the largest sweep among the tones of sessions."""
    best: Sweep | None = None
    for model in sessions:
        # Of two joints, a wave and its reverse are a lag sweep, too: they stay a reversal.
        if model is None or len(model.names) < 3:
            continue
        index = [
            k
            for k, session in enumerate(sessions)
            if session is not None and _alike(session, model)
        ]
        sweep = _sweep(index, [tones for k in index if (tones := sessions[k]) is not None])
        if sweep is not None and (best is None or _rank(sweep) > _rank(best)):
            best = sweep
    return best


def _rank(sweep: Sweep) -> tuple[bool, int]:
    return sweep.lacking == 0, len(sweep.index)


def _alike(tones: CommandTones, model: CommandTones) -> bool:
    if (tones.names, tones.robot, tones.omega.size) != (model.names, model.robot, model.omega.size):
        return False
    if np.any(np.abs(tones.omega - model.omega) > SAME_FREQUENCY * model.omega):
        return False
    ratio = np.linalg.norm(tones.command) / np.linalg.norm(model.command)
    return bool(1 / _ALIKE < ratio < _ALIKE)


def _sweep(index: Sequence[int], runs: Sequence[CommandTones]) -> Sweep | None:
    C = np.stack([run.command for run in runs], axis=1)  # joints, runs, lines
    m, r, lines = C.shape
    if r >= m:
        tones = tuple(k for k in range(lines) if np.linalg.cond(C[:, :, k]) <= MOST_CONDITION)
        return Sweep(tuple(index), runs[0].names, tones, lines) if tones else None
    # Fewer runs than joints: part of a sweep if they are all at right angles to each other.
    unit = C / np.linalg.norm(C, axis=0)
    gram = [np.abs(unit[:, :, k].conj().T @ unit[:, :, k] - np.eye(r)) for k in range(lines)]
    apart = [k for k, deviation in enumerate(gram) if deviation.max() < _ORTHOGONAL]
    if not apart or r < max(3, m / 2):
        return None
    return Sweep(tuple(index), runs[0].names, tuple(apart), lines, lacking=m - r)


@dataclass(frozen=True)
class SweepData:
    """What r runs of m joints gave at L tones.

    Attributes:
        omega: Of the tones, mean of the runs [rad/s], shape (L,).
        command: C of each tone [rad], shape (L, m, r).
        response: Y of each tone [rad].
        torque: T of each tone [N m]; None where some joint's torque is missing in some run.
        beside: Responses beside the tones, where nothing is commanded; None where the records are
            too short for them.
        period_s: Of the commands: a servo holds each so long [s].
        contact: Whether the robot touched anything; None where its sessions don't say.
        drift: Largest drift of a run's responses per cycle, that noise doesn't explain; 0 if none.
        robot: The robot as it ran, or None without a description.
        run: What the twin of the first run had; None of a real robot.
    """

    omega: FloatArray
    command: ComplexArray
    response: tuple[Phasors, ...]
    torque: tuple[Phasors, ...] | None
    beside: Beside | None
    torque_beside: Beside | None
    period_s: float
    contact: bool | None
    drift: float
    robot: Robot | None
    run: TwinRun | None


def sweep_data(
    sweep: Sweep, commanded: Sequence[CommandTones | None], paths: Sequence[Path], options: Options
) -> SweepData:
    """Read the runs of a sweep and fit them.

    Args:
        commanded: Tones of each session.
        paths: The files of all sessions.

    Raises:
        DataError: If a driven joint's response is missing in a run, or too short.
    """
    twins: list[TwinRun | None] = []
    robot: Robot | None = None
    omega: list[FloatArray] = []
    commands: list[ComplexArray] = []
    responses: list[ToneFit] = []
    torques: list[ToneFit] = []
    periods_s: list[float] = []
    drifts: list[float] = []
    lines: FloatArray = np.zeros(0)
    for k in sweep.index:
        tones = commanded[k]
        assert tones is not None  # noqa: S101 - a sweep is made of sessions with tones
        with Session.open(paths[k]) as session:
            robot = robot or session.robot_as_run
            twins.append(session.run)
            command, position, effort = read_signals(session, options)
        if lost := [name for name in sweep.names if name not in position]:
            raise DataError(f"{paths[k]}: no responses of {', '.join(lost)}")
        commanded_series, series = (
            [kind[name] for name in sweep.names] for kind in (command, position)
        )
        beside = _beside_lines(sweep, tones.omega, series)
        lines = beside if not omega else lines
        omega.append(tones.omega)
        commands.append(fit_tones(commanded_series, tones.omega, np.zeros(0)).amplitude)
        responses.append(fit_tones(series, tones.omega, beside))
        if all(name in effort for name in sweep.names):
            torques.append(fit_tones([effort[name] for name in sweep.names], tones.omega, beside))
        periods_s.append(max(signal.period_s for signal in commanded_series))
        drifts.append(_drift(series, tones.omega, responses[-1], len(sweep.index)))
    touched = [None if twin is None else twin.contact for twin in twins]
    at = list(sweep.tones)
    whole = len(torques) == len(responses)
    free = range(omega[0].size, omega[0].size + lines.size)
    return SweepData(
        omega=np.mean([run[at] for run in omega], axis=0),
        command=np.stack([command[:, at] for command in commands], axis=-1).swapaxes(0, 1),
        response=_phasors(responses, at),
        torque=_phasors(torques, at) if whole else None,
        beside=Beside(lines, _phasors(responses, free)) if lines.size else None,
        torque_beside=Beside(lines, _phasors(torques, free)) if lines.size and whole else None,
        period_s=float(np.median(periods_s)),
        contact=True if any(touched) else None if None in touched else False,
        drift=max(drifts),
        robot=robot,
        run=twins[0],
    )


def _beside_lines(sweep: Sweep, omega: FloatArray, series: Sequence[Series]) -> FloatArray:
    """Return frequencies at which only a nonlinear robot responds."""
    highest = NYQUIST_SHARE * 2 * np.pi / max(channel.period_s for channel in series)
    if omega.size == 1:
        lines: FloatArray = omega[0] * np.array([2.0, 3.0])
        return lines[lines < highest]
    step = common_step(omega)
    span = min(float(channel.t_s[-1] - channel.t_s[0]) for channel in series)
    if step is None or step * span < 2 * np.pi * _PERIODS:
        return np.zeros(0)
    top = min(round((omega[-1] + 2 * omega[0]) / step), _MOST_LINES)
    place: IntArray = np.arange(1, top + 1, dtype=np.int64)
    free: BoolArray = ~np.isin(place, np.round(omega / step))
    if len(sweep.tones) < omega.size:
        # The overtones of a gait underneath are its own, not what is mixed with the tones.
        under = next(k for k in range(omega.size) if k not in sweep.tones)
        free &= place % round(omega[under] / step) != 0
    lines = (step * place[free]).astype(np.float64)
    return lines[lines < highest]


def _phasors(fits: Sequence[ToneFit], lines: Sequence[int]) -> tuple[Phasors, ...]:
    return tuple(
        Phasors(
            np.stack([fit.amplitude[:, k] for fit in fits], axis=1),
            np.stack([fit.variance[:, k] for fit in fits], axis=1),
            np.stack([fit.dof[:, k] for fit in fits], axis=1),
        )
        for k in lines
    )


def _drift(series: Sequence[Series], omega: FloatArray, fit: ToneFit, runs: int) -> float:
    """Return the largest change of a tone's responses between the halves of a run, per cycle.

    It counts where it is above ``DRIFT_PER_CYCLE`` and an F test of all joints' changes against
    the noise rejects that they are noise, the chance of a false alarm shared among the runs.
    """
    middle = float(series[0].t_s[0] + series[0].t_s[-1]) / 2
    ends = ((-np.inf, middle), (middle, np.inf))
    halves = [[channel.between(start, stop) for channel in series] for start, stop in ends]
    lines = omega[0] * np.array([2.0, 3.0]) if omega.size == 1 else np.zeros(0)
    tones = omega.size
    first, second = (fit_tones(half, omega, lines).amplitude[:, :tones] for half in halves)
    change: ComplexArray = second - first
    cycles = omega * (middle - float(series[0].t_s[0])) / (2 * np.pi)
    size: FloatArray = np.linalg.norm(change, axis=0)
    size = size / np.linalg.norm(fit.amplitude[:, :tones], axis=0)
    # Two halves, each with twice the variance of the whole, in two parts.
    ratio = np.sum(np.abs(change) ** 2, axis=0) / np.sum(8 * fit.variance[:, :tones], axis=0)
    worst = 0.0
    for tone, per_cycle in enumerate((size / cycles).tolist()):
        dof = float(fit.dof[:, tone].sum())
        chance = float(fdtrc(2 * len(series), dof, float(ratio[tone]))) * omega.size * runs
        if per_cycle > DRIFT_PER_CYCLE and chance < _CHANCE_OF_DRIFT:
            worst = max(worst, per_cycle)
    return worst
