"""A predicted closed loop as text for a terminal: the answer, the limits, the modes."""

from __future__ import annotations

import math

import numpy as np

from undulog.capture.common.console import UNLIMITED

from ...results import formats
from ...results.oscillators import ClosedLoop, LoopMode
from ..tables import Column, Table
from .table import Sheet

_PART = 0.5
"""Joints with this share of a pattern's largest are named."""


def render_loop(loop: ClosedLoop, *, width: int = UNLIMITED, color: bool = False) -> str:
    """Set a prediction as text.

    Args:
        loop: The prediction.
        width: Columns of the terminal.
        color: Whether to use bold and dim type.

    Returns:
        Several lines, the last one ended.
    """
    sheet = Sheet(width, color=color)
    sheet.print(formats.sentence(loop.answer), "bold")
    for line in loop.limits:
        sheet.print(formats.sentence(line))
    sheet.print()
    sheet.table(_mode_table(loop))
    if loop.relaxation is not None:
        first, last = (np.array(loop.relaxation.phase_rad[k]) for k in (0, -1))
        left = np.linalg.norm(last - last.mean()) / np.linalg.norm(first - first.mean())
        sheet.print()
        sheet.print(
            f"Of the kick {100 * left:.0f} % of what tells the phases apart is left after "
            f"{loop.relaxation.times_s[-1]:.1f} s; all phases over time with --json."
        )
    sheet.print(
        "Method: d phi' = eps (diag(g cos D)(P - I) + diag(g sin D) R) d phi, nothing fitted; "
        f"g and D the gain and lag at {loop.frequency_hz:.3g} Hz"
        + (f", an age of {loop.age_s:g} s included" if loop.age_s > 0 else "")
        + "; intervals by drawing the errors of P, R, g and D anew.",
        "dim",
    )
    return sheet.text()


def _mode_table(loop: ClosedLoop) -> Table[tuple[int, LoopMode]]:
    columns: list[Column[tuple[int, LoopMode]]] = [
        Column("pattern", None, lambda row: str(row[0]), kind="word"),
        Column("rate 1/s (95 %)", None, lambda row: formats.estimate(row[1].rate, most=5)),
        Column("time s", None, lambda row: _time(row[1].rate.value or 0.0)),
        Column("turns rad/s", None, lambda row: row[1].turning.value, (4, 4), spare=1),
        Column("mostly in", None, lambda row: _mostly(row[1], loop.joints), kind="word", spare=2),
    ]
    return Table(columns, list(enumerate(loop.modes, start=1)))


def _time(rate: float) -> str:
    time = formats.number(1 / abs(rate), 1) if abs(rate) > 0 else formats.MISSING
    return f"{time}{' (grows)' if rate < 0 else ''}"


def _mostly(mode: LoopMode, joints: tuple[str, ...]) -> str:
    """Joints with most of a pattern, and their signs against the largest."""
    share = np.array(mode.pattern_abs)
    turn = np.array(mode.pattern_rad) - mode.pattern_rad[int(np.argmax(share))]
    return " ".join(
        f"{'+' if math.cos(turn[k]) >= 0 else formats.MINUS}{joints[k]}"
        for k in np.flatnonzero(share >= _PART * share.max()).tolist()
    )
