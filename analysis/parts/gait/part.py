"""The part that fits the gait of the window."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.remarks import Note, Remarks
from ...response.fitting import GaitFit, fit_at_period, fit_gait
from ...signals.session_signals import Signals
from ...signals.windows import Span, Stretch, whole_cycles
from ..artefacts.part import ARTEFACTS
from ..part import Part, Results


@dataclass(frozen=True)
class MeasuredGait:
    """The gait of the window.

    Attributes:
        fit: None where there is none.
        span: Its whole cycles; the window where there is no gait.
    """

    fit: GaitFit | None
    span: Span


def _gait(signals: Signals, done: Results, remarks: Remarks) -> MeasuredGait:
    """Fit the gait; a motion without commands at the period that the user states, if any."""
    sound, period_s = done[ARTEFACTS].sound, signals.options.period_s
    duration_s = signals.window.duration_s
    if period_s is None or signals.commands:
        if period_s is not None:
            remarks(Note("--period is of motions without commands: the commands have their own"))
        fit = fit_gait(signals.commands, sound, duration_s, remarks)
    else:
        fit = fit_at_period(sound, period_s, duration_s, remarks)
    return MeasuredGait(fit, _span(signals.window, signals.origin_ns, fit))


def _span(window: Stretch, origin_ns: int, gait: GaitFit | None) -> Span:
    start_s, stop_s = window.since(origin_ns)
    if gait is None:
        return Span(origin_ns, start_s, stop_s, 0)
    first_s, stop_s, cycles = whole_cycles(start_s, stop_s, gait.fit.frequency_hz)
    return Span(origin_ns, first_s, stop_s, cycles)


GAIT = Part("gait", _gait, ("artefacts",), of_commands=True)

PARTS = (GAIT,)
