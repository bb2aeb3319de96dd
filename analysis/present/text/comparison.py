"""A comparison as text for a terminal: the answer, what was changed, then the differences."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from undulog.capture.common.console import UNLIMITED, plain

from ...compare.answer import WORDS, in_people_units, signed
from ...compare.decisions import SIGNIFICANT
from ...results import formats
from ...results.comparison import BODY, Change, Comparison, Difference, Equivalence
from .table import put, sheet

if TYPE_CHECKING:
    from rich.table import Table


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
    text, prose, wide = sheet(width, color=color)
    prose.print(f"{comparison.answer}.", style="bold", markup=False)
    for side, sessions in (("A", comparison.a), ("B", comparison.b)):
        names = ", ".join(plain(Path(one.path).name) for one in sessions)
        prose.print(f"{side}: {names}", markup=False)
    if comparison.partial is not None:
        prose.print(f"Partial: {comparison.partial}", markup=False)
    prose.print()
    for line in _changed(comparison.changed):
        prose.print(line, markup=False)
    prose.print()
    put(prose, wide, _table(comparison), [("in margins",), ("A", "B")])
    if comparison.waveforms:
        prose.print()
        put(prose, wide, _waveforms(comparison), [("at gait phase °",)])
    prose.print()
    prose.print(_equivalence(comparison), markup=False)
    for warning in comparison.warnings:
        prose.print(f"Warning: {plain(warning)}", markup=False)
    prose.print(f"Method: {method(comparison)}", style="dim", markup=False)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def cells(one: Difference) -> tuple[str, str, str, str, str]:
    """A difference as people read it.

    Args:
        one: The difference.

    Returns:
        A, B, B - A with its interval, Holm's p, size in margins.
    """
    factor = math.degrees(1) if one.unit == "rad" else 1.0
    unit = {"rad": "°", "1": ""}.get(one.unit, f" {one.unit}")
    digits = formats.decimals_for_values([one.a * factor, one.b * factor], 4)
    quantity, of = in_people_units(one)
    return (
        formats.number(one.a * factor, digits) + unit,
        formats.number(one.b * factor, digits) + unit,
        signed(quantity, of),
        formats.p_value(one.p_holm),
        f"{one.size:.2g}",
    )


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


def _table(comparison: Comparison) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("joint", "quantity"):
        table.add_column(name, no_wrap=True)
    for name in ("A", "B", "B - A (95 %, all together)", "p (Holm)", "in margins"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in comparison.differences:
        where = "the body" if one.place == BODY else one.place
        style = "bold" if one.p_holm < SIGNIFICANT else ""
        table.add_row(escape(plain(where)), WORDS[one.quantity], *cells(one), style=style)
    return table


def _waveforms(comparison: Comparison) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("mean cycle of", no_wrap=True)
    for name in ("RMS of B - A °", "largest ° (95 %, by itself)", "at gait phase °"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in comparison.waveforms:
        estimate = formats.degrees(one.largest)
        table.add_row(
            escape(plain(one.name)),
            formats.number(math.degrees(one.rms_rad), 2),
            signed(estimate, ""),
            formats.number(math.degrees(one.largest_at_rad), 0),
        )
    return table


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
