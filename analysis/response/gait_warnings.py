"""Warnings of a gait's fit: joints that nothing drives, groups, and changes within the window."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from undulog.capture.common.console import Warn

from ..common.answer import distinct
from ..common.estimate import Estimate
from ..common.remarks import Note
from ..estimators.harmonic import HarmonicFit
from ..estimators.trends import Trend
from .changes import (
    LEAST_CYCLES,
    LEAST_EFFECTIVE,
    Pace,
    ResponseChanges,
)
from .groups import (
    RESOLUTION,
    Groups,
    MixedTone,
    mixed_tones,
)


def warn_changes(
    changes: ResponseChanges | None, pace: Pace | None, names: Sequence[str], warn: Warn
) -> None:
    """Report how the gait and the responses change, a sentence for each."""
    if pace is not None:
        warn(
            Note(
                f"the gait's frequency changes by {_within(pace.hz_per_s, ' Hz/s')}: gain and lag "
                "are taken over the phase of the commands"
            )
        )
    if changes is None:
        return
    if changes.amplitude_drift is not None:
        share = _within(changes.amplitude_drift, " %", 100.0)
        warn(
            Note(
                f"the gait's amplitude changes by {share} per cycle: gain and lag are means of the "
                "cycles' own"
            )
        )
    worst = int(np.argmax(np.abs(changes.per_joint)))
    gain, lag = changes.of_joint(worst)
    size = (
        f"{names[worst]} {{}} {_within(gain, ' %', 100.0)} in gain and "
        f"{_within(lag, ' degrees', 180 / np.pi)} of lag"
    )
    if changes.trend is Trend.DRIFTING:
        warn(
            f"not settled: the response of {size.format('drifts by')} per cycle, more than any "
            "other; gain and lag are means over the window"
        )
    elif changes.trend is Trend.SETTLING:
        warn(
            "not settled: the responses approach steady values with a time constant of "
            f"{_within(changes.time_constant_s, ' s')}, at the start "
            f"{size.format('is off by')}, more than any other; gain and lag are the steady values"
        )
    if changes.varies:
        most = int(np.argmax(np.hypot(*changes.scatter)))
        gain_sd, lag_sd = changes.scatter[:, most].tolist()
        warn(
            Note(
                f"gain and lag vary from cycle to cycle by more than noise, most at {names[most]} "
                f"(standard deviations {100 * gain_sd:.2g} % and {np.degrees(lag_sd):.2g} "
                "degrees): their intervals contain this"
            )
        )
    if changes.uncertain:
        warn(
            f"gain and lag vary from cycle to cycle: {changes.cycles} cycles show their means only "
            f"as well as {changes.slow.effective:.2g} independent ones would, so the intervals "
            f"may be too narrow; record at least {_needed(changes)} cycles"
        )


def _needed(changes: ResponseChanges) -> int:
    """Return the number of cycles of which enough would be independent, in tens."""
    needed = changes.cycles * 1.5 * LEAST_EFFECTIVE / min(changes.slow.effective, LEAST_EFFECTIVE)
    return -(-max(math.ceil(needed), 2 * LEAST_CYCLES) // 10) * 10


def _within(value: Estimate, unit: str, scale: float = 1.0) -> str:
    """Return a value with its interval in words."""
    text = f"{scale * (value.value or 0.0):+.3g}"
    if value.ci95 is None:
        return f"{text}{unit}"
    low, high = (f"{scale * end:+.3g}" for end in value.ci95)
    return f"{text}{unit} ({low} to {high})"


def warn_undriven(*, held: list[str], astray: list[str], unusable: list[str], warn: Warn) -> None:
    """Say once why joints have no gain and lag."""
    for joints, why in (
        (held, "held still by the command"),
        (astray, "commanded something else than the common rhythm"),
        (unusable, "commanded too seldom or too briefly"),
    ):
        if joints:
            count = f"{len(joints)} joints are" if len(joints) > 1 else "1 joint is"
            text = f"{count} {why}, gain and lag are null: {', '.join(joints)}"
            warn(Note(text) if joints is held else text)


def warn_groups(groups: Groups, fits: Sequence[HarmonicFit], duration_s: float, warn: Warn) -> None:
    """Report what limits an analysis by groups."""
    for close in groups.unresolved:
        low, high = distinct(close.low_hz, close.high_hz)
        need_s = RESOLUTION / (close.high_hz - close.low_hz)
        nulls = f"gain and lag of {', '.join(close.left)} are null"
        nulls = nulls if close.left else "they are analysed as one group"
        warn(
            f"one group or two can't be decided: {len(close.kept) + len(close.left)} joints are "
            f"commanded at {low} to {high} Hz, closer than {RESOLUTION:g}/T in {duration_s:.3g} s; "
            f"{nulls} (record {need_s:.3g} s or more)"
        )
    if len(fits) < 2:
        return
    names = [f"{fit.frequency_hz:.4g} Hz" for fit in fits]
    if tones := mixed_tones([fit.omega for fit in fits], duration_s):
        falls = "; ".join(_mixed(tone, names) for tone in tones)
        warn(
            f"frequencies of the groups are commensurate within {RESOLUTION:g}/T: {falls}; what a "
            "nonlinear body makes there is part of these joints' gain and lag, which hold for this "
            "operating point of all groups together"
        )


def _mixed(tone: MixedTone, names: Sequence[str]) -> str:
    """Name a mixed tone by its frequencies, e.g. ``3 x 0.954 Hz - 1.432 Hz``."""
    text = ""
    for group, factor in sorted(tone.factors.items(), key=lambda item: -item[1]):
        size = names[group] if abs(factor) == 1 else f"{abs(factor)} x {names[group]}"
        sign = (" - " if factor < 0 else " + ") if text else ""
        text += f"{sign}{size}"
    return f"{text} falls on {names[tone.group]}"
