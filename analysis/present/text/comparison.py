"""A comparison as text for a terminal: the answer, what was changed, then the differences."""

from __future__ import annotations

import math
from pathlib import Path

from undulog.capture.common.console import UNLIMITED, plain

from ...compare.answer import WORDS
from ...compare.decisions import SIGNIFICANT
from ...results import formats
from ...results.comparison import Change, Comparison, Equivalence
from ..tables import difference_table, waveform_table
from .table import Sheet

MOST_CHANGES = 12
"""Lines of what was changed; the rest is in the JSON."""

_DESIGNS = {
    "sessions": "one session a side, errors from each session's own noise (Welch-Satterthwaite)",
    "groups": "independent runs, errors from their scatter (Welch)",
    "pairs": "paired runs, errors from the scatter of their differences",
}


def render_comparison(
    comparison: Comparison, *, width: int = UNLIMITED, color: bool = False
) -> str:
    """Set a comparison as text.

    Args:
        comparison: The result.
        width: Columns of the terminal: sentences wrap there, tables leave out what they can spare.
        color: Whether to use bold and dim type.

    Returns:
        Several lines, the last one ended.
    """
    sheet = Sheet(width, color=color)
    sheet.print(f"{comparison.answer}.", "bold")
    for side, sessions in (("A", comparison.a), ("B", comparison.b)):
        names = ", ".join(plain(Path(one.path).name) for one in sessions)
        sheet.print(f"{side}: {names}")
    if comparison.partial is not None:
        sheet.print(f"Partial: {comparison.partial}")
    sheet.print()
    for line in _changed(comparison.changed):
        sheet.print(line)
    sheet.print()
    sheet.table(difference_table(comparison))
    if comparison.waveforms:
        sheet.print()
        sheet.table(waveform_table(comparison))
    sheet.print()
    sheet.print(_equivalence(comparison))
    for warning in comparison.warnings:
        sheet.print(f"Warning: {plain(warning)}")
    sheet.print(f"Method: {method(comparison)}", "dim")
    return sheet.text()


def _changed(changed: tuple[Change, ...]) -> list[str]:
    if not changed:
        return ["What was changed: the sessions say nothing of it; what they say is the same."]
    lines = ["What was changed (A, then B):"]
    for one in changed[:MOST_CHANGES]:
        a, b = (
            formats.short(value) if value is not None else "not set" for value in (one.a, one.b)
        )
        lines.append(f"  {plain(one.name)}: {a} -> {b}")
    rest = len(changed) - MOST_CHANGES
    return [*lines, f"  and {rest} more (--json)"] if rest > 0 else lines


def margin_told(one: Equivalence, value: float | None = None) -> str:
    """A margin, or a difference that is held to it, in the unit people read.

    Args:
        one: The test.
        value: In the test's unit; its margin if None.

    Returns:
        For example ``2 %``, ``0.35°`` or ``0.01 J``.
    """
    factor, unit = {"rad": (math.degrees(1), "°"), "1": (1.0, "")}.get(
        one.unit, (1.0, f" {one.unit}")
    )
    if one.quantity == "gain":
        factor, unit = 100.0, " %"
    return f"{(one.margin if value is None else value) * factor:.2g}{unit}"


def _equivalence(comparison: Comparison) -> str:
    parts: list[str] = []
    for one in comparison.equivalence:
        shown = "yes" if one.p < SIGNIFICANT else "not shown"
        parts.append(
            f"{WORDS[one.quantity]} within {margin_told(one)} {shown} (p {formats.p_value(one.p)})"
        )
    return f"The same within margins: {'; '.join(parts)}."


def method(comparison: Comparison) -> str:
    """How a comparison was made.

    Args:
        comparison: The result.

    Returns:
        One sentence, beginning in lower case.
    """
    return (
        f"aligned by gait phase; {_DESIGNS[comparison.design]}; decisions over all "
        f"{len(comparison.differences)} quantities after Holm at {100 * SIGNIFICANT:g} %, "
        "intervals hold together at 95 % after Bonferroni; the same within margins: two one-sided "
        "tests (TOST), each claim by itself at 5 %."
    )
