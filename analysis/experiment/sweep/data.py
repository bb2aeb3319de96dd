"""A sweep as phasors: commands, responses and torques of every run at every tone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import fdtrc

from undulog.capture import Session
from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import DataError
from undulog.capture.robot.model import Robot
from undulog.capture.robot.run import Run

from ...estimators.series import Series
from ...estimators.settling import DRIFT_PER_CYCLE, SIGNIFICANT
from ...response.gait import NYQUIST_SHARE
from ...signals.stretch import Options
from .chain import Phasors
from .distortion import Beside
from .runs import CommandTones, Signals, Sweep, read_signals
from .tones import ToneFit, common_step, fit_tones

_PERIODS = 1.5
"""Periods of a multisine in a record from which lines beside its tones are told apart."""

_MOST_LINES = 60


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
        torque_beside: Torques there.
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
    run: Run | None


@dataclass(frozen=True)
class _Run:
    omega: FloatArray
    command: ComplexArray
    response: ToneFit
    torque: ToneFit | None
    beside: FloatArray
    period_s: float
    drift: float


def sweep_data(
    sweep: Sweep, commanded: Sequence[CommandTones | None], paths: Sequence[Path], options: Options
) -> SweepData:
    """Read the runs of a sweep and fit them.

    Args:
        sweep: Which of the sessions they are.
        commanded: What each session commands.
        paths: The files of all sessions.
        options: What the user chose.

    Returns:
        The phasors.

    Raises:
        DataError: If a driven joint's response is missing in a run, or too short.
    """
    runs: list[_Run] = []
    twins: list[Run | None] = []
    robot: Robot | None = None
    for k in sweep.index:
        tones = commanded[k]
        assert tones is not None  # noqa: S101 - a sweep is made of sessions with tones
        with Session.open(paths[k]) as session:
            robot = robot or session.robot_as_run
            twins.append(session.run)
            signals = read_signals(session, options)
        lost = [name for name in sweep.names if name not in signals.position]
        if lost:
            raise DataError(f"{paths[k]}: no responses of {', '.join(lost)}")
        runs.append(_fit(sweep, tones.omega, signals, len(sweep.index)))
    touched = [None if one is None else one.contact for one in twins]
    tones_at = list(sweep.tones)
    whole = all(run.torque is not None for run in runs)
    torques = [run.torque for run in runs if run.torque is not None]
    responses = [run.response for run in runs]
    lines = runs[0].beside
    return SweepData(
        omega=np.mean([run.omega[tones_at] for run in runs], axis=0),
        command=np.stack([run.command[:, tones_at] for run in runs], axis=-1).swapaxes(0, 1),
        response=_by_tone(responses, tones_at),
        torque=_by_tone(torques, tones_at) if whole else None,
        beside=_beside(lines, responses) if lines.size else None,
        torque_beside=_beside(lines, torques) if lines.size and whole else None,
        period_s=float(np.median([run.period_s for run in runs])),
        contact=True if any(touched) else None if None in touched else False,
        drift=max(run.drift for run in runs),
        robot=robot,
        run=twins[0],
    )


def _fit(sweep: Sweep, omega: FloatArray, signals: Signals, runs: int) -> _Run:
    command, position = (
        [kind[name] for name in sweep.names] for kind in (signals.command, signals.position)
    )
    lines = _beside_lines(sweep, omega, position)
    effort = [signals.effort[name] for name in sweep.names if name in signals.effort]
    responses = fit_tones(position, omega, lines)
    return _Run(
        omega=omega,
        command=fit_tones(command, omega, np.zeros(0)).amplitude,
        response=responses,
        torque=fit_tones(effort, omega, lines) if len(effort) == len(sweep.names) else None,
        beside=lines,
        period_s=max(one.period_s for one in command),
        drift=_drift(position, omega, responses, runs),
    )


def _beside_lines(sweep: Sweep, omega: FloatArray, series: Sequence[Series]) -> FloatArray:
    """Frequencies at which a nonlinear robot answers though nothing is commanded."""
    highest = NYQUIST_SHARE * 2 * np.pi / max(one.period_s for one in series)
    if omega.size == 1:
        lines: FloatArray = omega[0] * np.array([2.0, 3.0])
        return lines[lines < highest]
    step = common_step(omega)
    span = min(float(one.t_s[-1] - one.t_s[0]) for one in series)
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


def _by_tone(fits: Sequence[ToneFit], tones: Sequence[int]) -> tuple[Phasors, ...]:
    return tuple(
        Phasors(
            np.stack([one.amplitude[:, k] for one in fits], axis=1),
            np.stack([one.variance[:, k] for one in fits], axis=1),
            np.stack([one.dof[:, k] for one in fits], axis=1),
        )
        for k in tones
    )


def _beside(omega: FloatArray, fits: Sequence[ToneFit]) -> Beside:
    least = np.stack([one.dof.min(axis=1) for one in fits], axis=1)
    return Beside(
        omega,
        tuple(
            Phasors(
                np.stack([one.beside[:, k] for one in fits], axis=1),
                np.stack([one.beside_variance[:, k] for one in fits], axis=1),
                least,
            )
            for k in range(omega.size)
        ),
    )


def _drift(series: Sequence[Series], omega: FloatArray, fit: ToneFit, runs: int) -> float:
    """Largest change of a tone's responses from one half of a run to the other, per cycle.

    It counts where it is above ``DRIFT_PER_CYCLE`` and an F test of all joints' changes against
    the noise rejects that they are noise, the chance of a false alarm shared among the runs.
    """
    middle = float(series[0].t_s[0] + series[0].t_s[-1]) / 2
    halves = [
        [one.between(start, stop) for one in series]
        for start, stop in ((-np.inf, middle), (middle, np.inf))
    ]
    lines = omega[0] * np.array([2.0, 3.0]) if omega.size == 1 else np.zeros(0)
    first, second = (fit_tones(half, omega, lines).amplitude for half in halves)
    change: ComplexArray = second - first
    span = middle - float(series[0].t_s[0])
    cycles = omega * span / (2 * np.pi)
    size: FloatArray = np.linalg.norm(change, axis=0) / np.linalg.norm(fit.amplitude, axis=0)
    # Two halves, each with twice the variance of the whole, in two parts.
    scatter: FloatArray = np.sum(8 * fit.variance, axis=0)
    ratio = np.sum(np.abs(change) ** 2, axis=0) / scatter
    worst = 0.0
    for tone, per_cycle in enumerate((size / cycles).tolist()):
        dof = float(fit.dof[:, tone].sum())
        chance = float(fdtrc(2 * len(series), dof, float(ratio[tone]))) * omega.size * runs
        if per_cycle > DRIFT_PER_CYCLE and chance < SIGNIFICANT:
            worst = max(worst, per_cycle)
    return worst
