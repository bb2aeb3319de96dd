"""The result as text for a terminal: the answer first, then the joints, the method last."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

from undulog.capture.common import text_table
from undulog.capture.common.console import UNLIMITED, plain

from ...results import formats
from ...results.analysis import Analysis
from ...results.null_model import ModelledAnalysis, told_null
from .. import tables
from ..tables import TERMINAL, Cell, Ends, PValue, Quantity
from .lines import more_lines
from .oscillators import chain_detail


class Sheet:
    """The text of a result for a terminal: sentences, wrapped, and tables."""

    def __init__(self, width: int, *, color: bool) -> None:
        """Begin.

        Args:
            width: Columns of the terminal.
            color: Whether to use bold and dim type.
        """
        from rich.console import Console

        self._text = StringIO()
        self._console = Console(
            file=self._text,
            width=max(width, 40),
            color_system="standard" if color else None,
            force_terminal=color,
            highlight=False,
            markup=False,
            emoji=False,
        )

    def print(self, line: str = "", style: str = "") -> None:
        """Add a sentence.

        Args:
            line: Any text; what would end a line or control a terminal is escaped.
            style: Of the line.
        """
        self._console.print(plain(line), style=style)

    def table(self, table: tables.AnyTable) -> None:
        """Add a table, without what it can spare where the terminal is too narrow for all of it.

        Args:
            table: The table.
        """
        columns = [column for column in table.columns if column.text is not None]
        cells = zip(*(column.cells(table.rows, TERMINAL) for column in columns), strict=True)
        styles = ["bold" if table.bold(row) else "" for row in table.rows]
        heads = [
            text_table.Column(column.text or "", left=column.kind != "number", spare=column.spare)
            for column in columns
        ]
        rows = [
            [(_shown(cell), style) for cell in row]
            for row, style in zip(cells, styles, strict=True)
        ]
        lines, left_out = text_table.table(heads, rows, self._console.width)
        for line in lines:
            self._console.print(line, soft_wrap=True)
        if left_out:
            names = ", ".join(left_out)
            self.print(f"Without {names}: the terminal is too narrow; --json has all.", "dim")

    def text(self) -> str:
        """Return all of it.

        Returns:
            Several lines, the last one ended.
        """
        return "\n".join(line.rstrip() for line in self._text.getvalue().splitlines()) + "\n"


def _shown(cell: Cell) -> str:
    match cell:
        case None:
            return formats.MISSING
        case Quantity(estimate, decimals, unit):
            value = formats.number(estimate.value, decimals) + unit
            return f"{value} {formats.interval(estimate.ci95, decimals)}".rstrip()
        case Ends(low, high):
            return f"{_shown(low)} to {_shown(high)}"
        case PValue():
            return formats.p_value(cell)
        case _:
            return str(cell)


def render(analysis: Analysis, *, width: int = UNLIMITED, color: bool = False) -> str:
    """Set a result as text.

    Args:
        analysis: The result.
        width: Columns of the terminal: sentences wrap there, tables leave out what they can spare.
        color: Whether to use bold and dim type.

    Returns:
        Several lines, the last one ended.
    """
    sheet = Sheet(width, color=color)
    name, answer = Path(analysis.session.path).name, analysis.answer
    sheet.print(f"{name}: {answer.sentence}", "bold")
    sheet.print(answer.detail)
    moved = [j for j in analysis.joints if j.gain.value is not None or j.flags]
    shown: list[tables.AnyTable] = [tables.joint_table(analysis, moved or analysis.joints)]
    if analysis.body is not None:
        shown.append(tables.body_table(analysis.body))
    if any(one.value is not None for one in analysis.heterogeneity.values()):
        shown.append(tables.index_table(analysis.heterogeneity))
    for table in shown:
        sheet.print()
        sheet.table(table)
    sheet.print()
    for line in more_lines(analysis):
        sheet.print(line)
    coupling = analysis.coupling
    if not coupling.identifiable:
        record = f" To identify it, record {coupling.record}." if coupling.record else ""
        sheet.print(f"Coupling: not identifiable: {coupling.why}.{record}")
    for chain in analysis.oscillators:
        for line in chain_detail(chain):
            sheet.print(line)
    if isinstance(analysis, ModelledAnalysis):
        for line in told_null(analysis.null_model):
            sheet.print(line)
    for warning in analysis.warnings:
        sheet.print(f"Warning: {warning}")
    sheet.print(_method(analysis), "dim")
    for note in analysis.notes:
        sheet.print(f"Note: {note}", "dim")
    return sheet.text()


def _method(analysis: Analysis) -> str:
    spans = ", ".join(f"{w.start_s:.2f} to {w.stop_s:.2f} s" for w in analysis.gait.windows)
    cycles = sum(w.cycles for w in analysis.gait.windows)
    gait = analysis.gait
    if gait.frequency_hz.value is None:
        return f"Method: energies integrated on the samples' own times over {spans}."
    fitted = gait.fitted
    span = "" if fitted is None else f" of {fitted.start_s:.2f} to {fitted.stop_s:.2f} s"
    rhythm = f"one frequency for all joints: {formats.estimate(gait.frequency_hz, ' Hz', most=6)}"
    if len(gait.groups) > 1:
        rhythm = (
            "one frequency for each group of joints, with the harmonics of all in every joint: "
            f"{formats.gait_frequency(gait)}"
        )
    return (
        f"Method: harmonic least squares{span} on each sample's own time, {rhythm}; "
        "95 % intervals from the residual's spectrum beside it, Student's t; "
        f"lag positive = response late; energies over {cycles:.0f} whole cycles, {spans}."
    )
