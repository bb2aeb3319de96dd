"""The result as text for a terminal: the answer first, then the joints, the method last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undulog.capture.common.console import UNLIMITED, plain

from ...results import formats
from ...results.analysis import Analysis, BodyResult, Index, JointResult
from ...results.estimate import Estimate
from ...results.null_model import ModelledAnalysis, told_null
from .lines import more_lines
from .oscillators import chain_detail

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


_SPARE: list[tuple[str, ...]] = [
    (name,) for name in ("plane", "cover", "E_net J", "E_el J", "command°", "E_abs J")
]
"""Columns of the table of joints that a narrow terminal goes without."""


def sheet(width: int, *, color: bool) -> tuple[StringIO, Console, Console]:
    """Where a result is set.

    Args:
        width: Columns of the terminal.
        color: Whether to use bold and dim type.

    Returns:
        The text, what writes sentences into it, wrapped, and what writes lines of any width.
    """
    from rich.console import Console

    text = StringIO()

    class Sheet(Console):
        """A console for sentences and tables with names from logs, each sentence one line."""

        def print(self, *objects: Any, **how: Any) -> None:
            super().print(*(plain(o) if isinstance(o, str) else o for o in objects), **how)

    def console(columns: int) -> Console:
        system = "standard" if color else None
        return Sheet(
            file=text, width=columns, color_system=system, force_terminal=color, highlight=False
        )

    return text, console(max(width, 40)), console(UNLIMITED)


def put(prose: Console, wide: Console, table: Table, spare: Sequence[tuple[str, ...]]) -> None:
    """Print a table, without what it can spare where the terminal is too narrow for all of it.

    Args:
        prose: As wide as the terminal.
        wide: Prints it, unwrapped.
        table: The table.
        spare: Headings of columns that may go, those that go together, the first ones first.
    """
    from rich.measure import Measurement

    left: list[str] = []
    table = _without(table, ())  # with its names escaped
    for names in spare:
        if Measurement.get(wide, wide.options, table).maximum <= prose.width:
            break
        left += [name for name in names if any(one.header == name for one in table.columns)]
        table = _without(table, names)
    wide.print(table)
    if left:
        told = f"Without {', '.join(left)}: the terminal is too narrow; --json has all."
        prose.print(told, style="dim", markup=False)


def _without(table: Table, names: tuple[str, ...]) -> Table:
    """A table without the columns of those headings, its names fit for a terminal."""
    from rich.table import Table

    fewer = Table(box=None, pad_edge=False, header_style="bold")
    kept = [column for column in table.columns if column.header not in names]
    for column in kept:
        fewer.add_column(plain(str(column.header)), justify=column.justify, no_wrap=column.no_wrap)
    for row, *cells in zip(table.rows, *(column.cells for column in kept), strict=True):
        fewer.add_row(*(plain(str(cell)) for cell in cells), style=row.style)
    return fewer


def render(analysis: Analysis, *, width: int = UNLIMITED, color: bool = False) -> str:
    """Set a result as text.

    Args:
        analysis: The result.
        width: Columns of the terminal: sentences wrap there, tables leave out what they can spare.
        color: Whether to use bold and dim type.

    Returns:
        Several lines, the last one ended.
    """
    text, prose, wide = sheet(width, color=color)
    name, told = Path(analysis.session.path).name, analysis.answer
    prose.print(f"{name}: {told.sentence}", style="bold", markup=False)
    prose.print(told.detail, markup=False)
    tables: list[tuple[Table, list[tuple[str, ...]]]] = [(_joint_table(analysis), _SPARE)]
    if analysis.body is not None:
        table = _body_table(analysis.body)
        tables.append(
            (table, [("phase°",), tuple(f"{name} null mm" for name in analysis.body.null)])
        )
    if any(one.value is not None for one in analysis.heterogeneity.values()):
        tables.append((_index_table(analysis.heterogeneity), [("what",), ("unit",)]))
    for table, spare in tables:
        prose.print()
        put(prose, wide, table, spare)
    prose.print()
    for line in more_lines(analysis):
        prose.print(line, markup=False)
    coupling = analysis.coupling
    if not coupling.identifiable:
        record = f" To identify it, record {coupling.record}." if coupling.record else ""
        prose.print(f"Coupling: not identifiable: {coupling.why}.{record}", markup=False)
    for chain in analysis.oscillators:
        for line in chain_detail(chain):
            prose.print(line, markup=False)
    if isinstance(analysis, ModelledAnalysis):
        for line in told_null(analysis.null_model):
            prose.print(line, markup=False)
    for warning in analysis.warnings:
        prose.print(f"Warning: {warning}", markup=False)
    prose.print(_method(analysis), style="dim", markup=False)
    for note in analysis.notes:
        prose.print(f"Note: {note}", style="dim", markup=False)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def _estimate(estimate: Estimate, decimals: int, scale: float = 1.0) -> str:
    quantity = formats.scaled(estimate, scale)
    value = formats.number(quantity.value, decimals)
    return f"{value} {formats.interval(quantity.ci95, decimals)}".rstrip()


def _joint_table(analysis: Analysis) -> Table:
    from rich.table import Table

    moved = [j for j in analysis.joints if j.gain.value is not None or j.flags]
    joints = moved or list(analysis.joints)
    energies: list[tuple[str, list[float | None]]] = [
        ("E_net", [j.energy_net_j for j in joints]),
        ("E_abs", [j.energy_abs_j for j in joints]),
        ("E_el", [j.energy_el_j for j in joints]),
    ]
    shown = [(name, values) for name, values in energies if any(v is not None for v in values)]
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("joint", no_wrap=True)
    table.add_column("plane", no_wrap=True)
    several = len(analysis.gait.groups) > 1
    if several:
        table.add_column("Hz", justify="right", no_wrap=True)
    for name in ("command°", "gain (95 %)", "lag° (95 %)"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, _ in shown:
        table.add_column(f"{name} J", justify="right", no_wrap=True)
    table.add_column("cover", justify="right", no_wrap=True)
    table.add_column("flags")
    energy_digits = {name: formats.decimals_for_values(values) for name, values in shown}
    gain_digits = formats.decimals_for([j.gain for j in joints], most=4)
    lag_digits = formats.decimals_for([formats.degrees(j.lag_rad) for j in joints], most=2)
    for k, joint in enumerate(joints):
        amplitude = joint.command_amplitude_rad
        table.add_row(
            *_names(joint),
            *([formats.number(joint.frequency_hz, 3)] if several else []),
            formats.number(None if amplitude is None else math.degrees(amplitude), 1),
            _estimate(joint.gain, gain_digits),
            _estimate(joint.lag_rad, lag_digits, math.degrees(1)),
            *(formats.number(values[k], energy_digits[name]) for name, values in shown),
            formats.coverage(joint.coverage),
            " ".join(joint.flags),
        )
    return table


def _names(joint: JointResult) -> tuple[str, str]:
    from rich.markup import escape

    return escape(joint.name), joint.plane or formats.MISSING


def _body_table(body: BodyResult) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column(f"body, {body.plane}", no_wrap=True)
    table.add_column("link", no_wrap=True)
    for name in ("seen mm (95 %)", "phase° (95 %)"):
        table.add_column(name, justify="right", no_wrap=True)
    for name in body.null:
        table.add_column(f"{name} null mm", justify="right", no_wrap=True)
        table.add_column("phase°", justify="right", no_wrap=True)
    for k, point in enumerate(body.observed):
        nulls: list[str] = []
        for points in body.null.values():
            nulls.append(_estimate(points[k].amplitude_m, 1, 1000.0))
            nulls.append(_estimate(points[k].phase_rad, 1, math.degrees(1)))
        table.add_row(
            point.place,
            escape(point.link),
            _estimate(point.amplitude_m, 1, 1000.0),
            _estimate(point.phase_rad, 1, math.degrees(1)),
            *nulls,
        )
    return table


def _index_table(indices: dict[str, Index]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("index", no_wrap=True)
    for name in ("value (95 %)", "unit", "p"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("what", no_wrap=True)
    for name, index in indices.items():
        angle = index.unit == "rad"
        table.add_row(
            name,
            _estimate(Estimate(index.value, index.ci95), 4, math.degrees(1) if angle else 1.0),
            "°" if angle else index.unit,
            formats.p_value(index.p),
            index.label,
        )
    return table


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
