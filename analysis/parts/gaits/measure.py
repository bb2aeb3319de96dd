"""The gaits of a session whose gait changes, each fitted in its own window."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.robot.model import Robot

from ...common.estimate import Estimate
from ...common.remarks import Remarks
from ...estimators.intervals import around, t_factor
from ...response.fitting import GaitFit, fit_gait
from ...signals.columns import Columns
from ...signals.stretch import Choice, series_in
from ...signals.windows import Stretch
from ..artefacts.result import Artefact
from ..joints.measure import main_wave, response_estimates
from .result import GaitWindow, JointInWindow

MOST_GAITS = 16
"""Windows that are fitted, the longest ones: an hour in which the gait changes each minute is
compared over a quarter of it, which is more than any one of its gaits."""


@dataclass(frozen=True)
class FittedGait:
    """A gait and the window that it is constant in."""

    stretch: Stretch
    fit: GaitFit


def gaits_in_windows(
    columns: Columns,
    choice: Choice,
    longest: GaitFit | None,
    artefacts: Iterable[Artefact],
    start_ns: int,
) -> list[FittedGait]:
    """Fit the gait of each window in which it is constant.

    Args:
        longest: Fit of the longest window.
        artefacts: Of the session; joints whose positions they falsify within a window are left
            out of it.
        start_ns: Unix time of the session's start [ns].

    Returns:
        In order of time, without windows that hold no gait; none where the gait doesn't change.
    """
    if longest is None or len(choice.gaits) < 2:
        return []
    chosen = sorted(choice.gaits, key=lambda window: -window.duration_s)[:MOST_GAITS]
    false = [artefact for artefact in artefacts if artefact.falsifies("position")]
    fitted: list[FittedGait] = []
    for window in sorted(chosen, key=lambda window: window.start_ns):
        fit: GaitFit | None = longest
        if window != choice.stretch:
            during = window.since(start_ns)
            out = {artefact.joint for artefact in false if artefact.within(*during)}
            fit = _fit(columns, window, out)
        if fit is not None:
            fitted.append(FittedGait(window, fit))
    return fitted


def _fit(columns: Columns, window: Stretch, out: set[str]) -> GaitFit | None:
    origin_ns = window.start_ns + (window.stop_ns - window.start_ns) // 2
    sound = [name for name in columns.names if name not in out]
    commands = series_in(columns.names, columns.command, window, origin_ns)
    responses = series_in(sound, columns.position, window, origin_ns)
    return fit_gait(commands, responses, window.duration_s, Remarks())


def gait_windows(
    robot: Robot | None, gaits: Sequence[FittedGait], start_ns: int
) -> tuple[GaitWindow, ...]:
    """Return the response of each gait's joints.

    Args:
        start_ns: Unix time of the session's start [ns].
    """
    return tuple(_window(robot, gait, start_ns) for gait in gaits)


def _window(robot: Robot | None, gait: FittedGait, start_ns: int) -> GaitWindow:
    fit = gait.fit
    start_s, stop_s = gait.stretch.since(start_ns)
    frequency = fit.fit.frequency_hz
    half = t_factor(fit.omega_dof) * fit.omega_error / (2 * np.pi)
    joints: list[JointInWindow] = []
    for group in fit.groups:
        for name in group.driven:
            gain, lag = response_estimates(group, name)
            joints.append(JointInWindow(name, fit.command_amplitudes.get(name), gain, lag))
    return GaitWindow(
        start_s,
        stop_s,
        (stop_s - start_s) * frequency,
        Estimate(frequency, around(frequency, half)),
        main_wave(robot, fit)[0],
        tuple(joints),
    )
