"""Which sessions are runs of one lag sweep or multisine: told from their commands alone.

They drive the same joints at the same frequencies, and at a frequency their commands, one column a
run, make a matrix C of full rank and small condition number: that is what H = Y C^-1 needs, and
neither repeats of a gait nor kicks around one have it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray

from ...estimators.series import Series, clean
from ...response.gait import DRIVEN_SHARE
from ...session.analyse import Examined
from ...session.runs import SAME_FREQUENCY
from ...signals.reading import read_columns
from ...signals.stretch import Options, choose_stretch
from .tones import find_tones, fit_tones

MOST_CONDITION = 10.0
"""Commands with a larger condition number make no sweep; a DFT matrix has 1."""

_PURE = 1e-5
"""Share of the commands' variance that a single tone may leave unexplained."""

_ALIKE = 1.5
"""Runs whose commands are larger or smaller by this factor are of another amplitude."""

_ORTHOGONAL = 0.1


@dataclass(frozen=True)
class CommandTones:
    """What one session commands.

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


@dataclass(frozen=True)
class Signals:
    """Signals of a session's stretch, by joint name, in seconds from its middle."""

    command: dict[str, Series]
    position: dict[str, Series]
    effort: dict[str, Series]


def read_signals(session: SessionView, options: Options) -> Signals:
    """Read what a sweep is computed from.

    Args:
        session: An open session, examined before: what it lacks has been told.
        options: What the user chose.

    Returns:
        The signals of the analysed stretch.
    """

    def silent(_: str) -> None:
        """The first reading has told what is missing."""

    columns = read_columns(session, options.command_topic, options.response_topic, silent)
    stretch = choose_stretch(session, columns, options, silent)
    origin_ns = stretch.start_ns + (stretch.stop_ns - stretch.start_ns) // 2
    half_s = stretch.duration_s / 2
    command, position, effort = (
        {
            name: clean(name, signals[name].t_ns, signals[name].values, origin_ns).between(
                -half_s, half_s
            )
            for name in columns.names
            if name in signals
        }
        for signals in (columns.command, columns.position, columns.effort)
    )
    return Signals(command, position, effort)


def command_tones(
    session: SessionView, options: Options, examined: Examined
) -> CommandTones | None:
    """What a session commands, as tones.

    Args:
        session: An open session.
        options: What the user chose.
        examined: Its analysis.

    Returns:
        The gait's frequency alone, or the tones of a multisine; None of anything else.
    """
    gait, robot = examined.gait, examined.analysis.session.robot
    if gait is not None and gait.driven and not gait.others:
        m = len(gait.driven)
        left = float(gait.fit.rss[:m].sum() / gait.fit.total[:m].sum())
        if left < _PURE:
            omega = np.array([gait.fit.omega])
            return CommandTones(gait.driven, robot, omega, gait.fit.fundamental[:m, None])
    commands = [one for one in read_signals(session, options).command.values() if one.count > 64]
    found = find_tones(commands)
    if found is None:
        return None
    amplitude = fit_tones(commands, found, np.zeros(0)).amplitude
    size = np.abs(amplitude).max(axis=1)
    driven: BoolArray = size > DRIVEN_SHARE * size.max()
    names = tuple(one.name for one, moves in zip(commands, driven, strict=True) if moves)
    return CommandTones(names, robot, found, amplitude[driven])


def find_sweep(sessions: Sequence[CommandTones | None]) -> Sweep | None:
    """The largest sweep among sessions.

    Args:
        sessions: What each commands.

    Returns:
        The sweep, or None.
    """
    best: Sweep | None = None
    for model in sessions:
        # Of two joints, a wave and its reverse are a lag sweep, too: they stay a reversal.
        if model is None or len(model.names) < 3:
            continue
        index = [k for k, one in enumerate(sessions) if one is not None and _alike(one, model)]
        found = _sweep(index, [one for k in index if (one := sessions[k]) is not None])
        if found is not None and (best is None or _rank(found) > _rank(best)):
            best = found
    return best


def _rank(sweep: Sweep) -> tuple[bool, int]:
    return sweep.lacking == 0, len(sweep.index)


def _alike(one: CommandTones, model: CommandTones) -> bool:
    if (one.names, one.robot, one.omega.size) != (model.names, model.robot, model.omega.size):
        return False
    if np.any(np.abs(one.omega - model.omega) > SAME_FREQUENCY * model.omega):
        return False
    ratio = np.linalg.norm(one.command) / np.linalg.norm(model.command)
    return bool(1 / _ALIKE < ratio < _ALIKE)


def _sweep(index: Sequence[int], runs: Sequence[CommandTones]) -> Sweep | None:
    C = np.stack([one.command for one in runs], axis=1)  # joints, runs, lines
    m, r, lines = C.shape
    if r >= m:
        tones = tuple(k for k in range(lines) if np.linalg.cond(C[:, :, k]) <= MOST_CONDITION)
        return Sweep(tuple(index), runs[0].names, tones, lines) if tones else None
    # Fewer runs than joints: part of a sweep if they are all at right angles to each other.
    unit = C / np.linalg.norm(C, axis=0)
    apart = [
        k
        for k in range(lines)
        if np.abs(unit[:, :, k].conj().T @ unit[:, :, k] - np.eye(r)).max() < _ORTHOGONAL
    ]
    if not apart or r < max(3, m / 2):
        return None
    return Sweep(tuple(index), runs[0].names, tuple(apart), lines, lacking=m - r)
