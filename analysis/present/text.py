"""Write results as text for a terminal: the answer first, the method last."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from io import StringIO
from pathlib import Path

import numpy as np

from undulog.capture.common import console as text_table
from undulog.capture.common.console import UNLIMITED, plain

from ..common import formats
from ..parts.artefacts.show import artefact_line
from ..parts.body.show import body_table, shape_lines
from ..parts.dead_band.show import dead_band_line
from ..parts.energy.show import energy_lines
from ..parts.free_motion.result import FreeMotion
from ..parts.free_motion.show import local_waves_table, motion_table, wave_table
from ..parts.frequency_response.show import frequency_table
from ..parts.gait.show import gait_frequency
from ..parts.gaits.show import gait_table
from ..parts.ground_contact.show import contact_lines
from ..parts.heterogeneity.show import index_table
from ..parts.oscillators.show import chain_detail
from ..parts.over_time.show import over_time_lines
from ..parts.shown import TERMINAL, AnyTable, Cell, Column, Ends, PValue, Shown, ShownNumber, Table
from ..parts.tracking.show import tracking_table
from ..results.analysis import Analysis
from ..results.comparison import ModelledAnalysis, null_model_text
from ..results.coupling import Coupling
from ..results.oscillators import BodyOscillators, ClosedLoop, LoopMode
from . import tables

_PART = 0.5
"""Joints with this share of a pattern's largest are named."""


def more_lines(analysis: Analysis) -> Iterator[str]:
    """Yield the lines of text after the tables."""
    yield from shape_lines(analysis.body_shape)
    yield from contact_lines(analysis.ground_contact)
    if analysis.energy is not None:
        yield from energy_lines(analysis.energy)
    if analysis.over_time is not None and analysis.gait.frequency_hz.value is None:
        yield from over_time_lines(analysis.over_time)
    for joint in analysis.joints:
        if joint.dead_band is not None:
            yield dead_band_line(joint.name, joint.dead_band)
    for artefact in analysis.artefacts:
        yield artefact_line(artefact)


def body_detail(body: BodyOscillators) -> Iterable[str]:
    """Yield sentences on oscillators with feedback from their servos, the answer first."""
    yield f"Oscillators that feel their servos: {body.answer}."
    worst = max(mode.sensitivity for mode in body.modes)
    noise = body.pseudospectrum.noise
    yield (
        f"I - P is a signed Laplacian and not normal (a rate moves by up to {worst:.1f} times an "
        f"error of P, whose norm is below {noise:.2g}); a deviation may grow for a while at "
        f"{formats.estimate(body.growth, ' eps')}."
    )


def unidentified(coupling: Coupling) -> str:
    """Return why a coupling isn't identifiable, and what to record."""
    record = f" To identify it, record {coupling.record}." if coupling.record else ""
    return f"Coupling: not identifiable: {coupling.why}.{record}"


class Sheet:
    """The text of a result for a terminal: sentences, wrapped, and tables."""

    def __init__(self, width: int, *, color: bool) -> None:
        """Make an empty sheet; with ``color`` it has bold and dim type."""
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
        """Add a sentence; line ends and control characters are escaped."""
        self._console.print(plain(line), style=style)

    def lines(self, lines: Iterable[str], style: str = "") -> None:
        """Add sentences."""
        for line in lines:
            self.print(line, style)

    def table(self, table: AnyTable) -> None:
        """Add an empty line and a table; a narrow terminal goes without columns to spare."""
        self.print()
        columns = [column for column in table.columns if column.text is not None]
        cells = zip(*(column.cells(table.rows, TERMINAL) for column in columns), strict=True)
        styles = ["bold" if table.bold(row) else "" for row in table.rows]
        heads = [
            text_table.TerminalColumn(
                column.text or "", left=column.kind != "number", spare=column.spare
            )
            for column in columns
        ]
        styled = zip(cells, styles, strict=True)
        rows = [[(_shown(cell), style) for cell in row] for row, style in styled]
        lines, left_out = text_table.table(heads, rows, self._console.width)
        for line in lines:
            self._console.print(line, soft_wrap=True)
        if names := ", ".join(left_out):
            self.print(f"Without {names}: the terminal is too narrow; --json has all.", "dim")

    def text(self) -> str:
        """Return all lines, the last one ended."""
        return "\n".join(line.rstrip() for line in self._text.getvalue().splitlines()) + "\n"


def _shown(cell: Cell) -> str:
    match cell:
        case None:
            return formats.MISSING
        case ShownNumber(estimate, decimals, unit):
            value = formats.number(estimate.value, decimals) + unit
            return f"{value} {formats.interval(estimate.ci95, decimals)}".rstrip()
        case Ends(low, high):
            return f"{_shown(low)} to {_shown(high)}"
        case PValue():
            return formats.p_value(cell)
        case _:
            return str(cell)


def render(analysis: Analysis, *, width: int = UNLIMITED, color: bool = False) -> str:
    """Return a session's result as text.

    Args:
        width: Columns of the terminal: sentences wrap, tables leave out spare columns.
        color: Whether to use bold and dim type.
    """
    sheet = Sheet(width, color=color)
    name, answer = Path(analysis.session.path).name, analysis.answer
    sheet.print(f"{name}: {answer.sentence}", "bold")
    sheet.print(answer.detail)
    for table in _tables(analysis):
        sheet.table(table)
    for part in shown_parts(analysis).values():
        sheet.print()
        sheet.print(f"{part.title}:")
        for table in part.tables:
            sheet.table(table)
    sheet.print()
    sheet.lines(more_lines(analysis))
    if not analysis.coupling.identifiable:
        sheet.print(unidentified(analysis.coupling))
    for chain in analysis.oscillators:
        sheet.lines(chain_detail(chain))
    if isinstance(analysis, ModelledAnalysis):
        sheet.lines(null_model_text(analysis.null_model))
    sheet.lines(f"Warning: {warning}" for warning in analysis.warnings)
    sheet.print(_method(analysis), "dim")
    sheet.lines((f"Note: {note}" for note in analysis.notes), "dim")
    return sheet.text()


def _tables(analysis: Analysis) -> list[AnyTable]:
    """Return the tables of a session, the joints first."""
    moved = [j for j in analysis.joints if j.gain.value is not None or j.flags]
    shown: list[AnyTable] = [tables.joint_table(analysis, moved or analysis.joints)]
    if analysis.gaits:
        shown.append(gait_table(analysis.gaits))
    if analysis.tracking:
        shown = [] if analysis.gait.frequency_hz.value is None else shown
        shown.append(tracking_table(analysis.tracking))
    if analysis.frequency_response:
        shown = shown if analysis.tracking else []
        shown.append(frequency_table(analysis.frequency_response))
    if analysis.free_motion is not None and analysis.free_motion.joints:
        shown = _of_motion(analysis.free_motion)
    if analysis.body is not None:
        shown.append(body_table(analysis.body))
    if any(index.value is not None for index in analysis.heterogeneity.values()):
        shown.append(index_table(analysis.heterogeneity))
    return shown


def shown_parts(analysis: Analysis) -> dict[str, Shown]:
    """Return tables and figures of the parts that other packages add, by name."""
    if not analysis.more:
        return {}
    from ..session.added_parts import shown

    parts = {name: shown(name, result) for name, result in analysis.more.items()}
    return {name: part for name, part in parts.items() if part is not None}


def _of_motion(motion: FreeMotion) -> list[AnyTable]:
    """Return the tables of a motion without commands."""
    shown: list[AnyTable] = [motion_table(motion.joints)]
    if motion.waves:
        shown.append(wave_table(motion.waves))
    if any(wave.local for wave in motion.waves):
        shown.append(local_waves_table(motion.waves))
    return shown


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
            f"{gait_frequency(gait)}"
        )
    return (
        f"Method: harmonic least squares{span} on each sample's own time, {rhythm}; "
        "95 % intervals from the residual's spectrum beside it, Student's t; "
        f"lag positive = response late; energies over {cycles:.0f} whole cycles, {spans}."
    )


def render_loop(loop: ClosedLoop, *, width: int = UNLIMITED, color: bool = False) -> str:
    """Return a prediction as text; see :func:`render`."""
    sheet = Sheet(width, color=color)
    sheet.print(formats.sentence(loop.answer), "bold")
    sheet.lines(map(formats.sentence, loop.limits))
    sheet.table(_mode_table(loop))
    if loop.relaxation is not None:
        first, last = (np.array(loop.relaxation.phase_rad[k]) for k in (0, -1))
        left = np.linalg.norm(last - last.mean()) / np.linalg.norm(first - first.mean())
        sheet.print()
        sheet.print(
            f"Of the kick {100 * left:.0f} % of the phase differences is left after "
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
    """Return the joints with most of a pattern, with their signs relative to the largest."""
    share = np.array(mode.pattern_abs)
    turn = np.array(mode.pattern_rad) - mode.pattern_rad[int(np.argmax(share))]
    return " ".join(
        f"{'+' if math.cos(turn[k]) >= 0 else formats.MINUS}{joints[k]}"
        for k in np.flatnonzero(share >= _PART * share.max()).tolist()
    )
