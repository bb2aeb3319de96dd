"""A predicted closed loop as text for a terminal: the answer, the limits, the modes."""

from __future__ import annotations

import math

import numpy as np

from undulog.capture.common.console import UNLIMITED

from ...results import formats
from ...results.oscillators import ClosedLoop, LoopMode
from .table import put, sheet

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
    from rich.markup import escape
    from rich.table import Table

    text, prose, wide = sheet(width, color=color)
    prose.print(formats.sentence(loop.answer), style="bold", markup=False)
    for line in loop.limits:
        prose.print(formats.sentence(line), markup=False)
    prose.print()
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("pattern", no_wrap=True)
    for name in ("rate 1/s (95 %)", "time s", "turns rad/s"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("mostly in")
    for k, mode in enumerate(loop.modes, start=1):
        rate = mode.rate.value or 0.0
        time = formats.number(1 / abs(rate), 1) if abs(rate) > 0 else formats.MISSING
        table.add_row(
            str(k),
            formats.estimate(mode.rate, most=5),
            f"{time}{' (grows)' if rate < 0 else ''}",
            formats.number(mode.turning.value, 4),
            escape(_mostly(mode, loop.joints)),
        )
    put(prose, wide, table, [("turns rad/s",), ("mostly in",)])
    if loop.relaxation is not None:
        first, last = (np.array(loop.relaxation.phase_rad[k]) for k in (0, -1))
        left = np.linalg.norm(last - last.mean()) / np.linalg.norm(first - first.mean())
        prose.print()
        prose.print(
            f"Of the kick {100 * left:.0f} % of what tells the phases apart is left after "
            f"{loop.relaxation.times_s[-1]:.1f} s; all phases over time with --json.",
            markup=False,
        )
    prose.print(
        "Method: d phi' = eps (diag(g cos D)(P - I) + diag(g sin D) R) d phi, nothing fitted; "
        f"g and D the gain and lag at {loop.frequency_hz:.3g} Hz"
        + (f", an age of {loop.age_s:g} s included" if loop.age_s > 0 else "")
        + "; intervals by drawing the errors of P, R, g and D anew.",
        style="dim",
        markup=False,
    )
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def _mostly(mode: LoopMode, joints: tuple[str, ...]) -> str:
    """Joints with most of a pattern, and their signs against the largest."""
    share = np.array(mode.pattern_abs)
    turn = np.array(mode.pattern_rad) - mode.pattern_rad[int(np.argmax(share))]
    return " ".join(
        f"{'+' if math.cos(turn[k]) >= 0 else formats.MINUS}{joints[k]}"
        for k in np.flatnonzero(share >= _PART * share.max()).tolist()
    )
