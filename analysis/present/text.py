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
from ..common.estimate import Estimate
from ..parts.body.result import BodyShape, PlaneShape
from ..parts.energy.result import EnergyResult
from ..parts.free_motion.result import FreeMotion
from ..parts.gait.show import gait_frequency
from ..parts.ground_contact.result import GroundContact
from ..parts.oscillators.result import ChainCoupling
from ..parts.shown import TERMINAL, AnyTable, Cell, Column, Ends, PValue, Shown, ShownNumber, Table
from ..results.analysis import Analysis
from ..results.comparison import ModelledAnalysis, null_model_text
from ..results.coupling import Coupling
from ..results.oscillators import BodyOscillators, ClosedLoop, LoopMode
from . import tables
from .response_tables import (
    frequency_table,
    gait_table,
    local_waves_table,
    motion_table,
    tracking_table,
    wave_table,
)

_ABOUT = {
    "sensor": "Artefact of the sensor",
    "sensor or joint": "Sensor or joint",
    "sensor or limit": "Sensor or limit",
    "record": "Artefact of the record",
    "limit": "At a limit",
}

_SPANS = 3
"""Stretches of an artefact that a line names at most."""

_LIFTED = 0.9
"""Where links are on the ground for more of a cycle, on the mean, nothing is lifted."""

_PART = 0.5
"""Joints with this share of a pattern's largest are named."""


def more_lines(analysis: Analysis) -> Iterator[str]:
    """Yield the lines of text after the tables."""
    yield from shape_lines(analysis.body_shape)
    yield from contact_lines(analysis.ground_contact)
    if analysis.energy is not None:
        yield from _energy(analysis.energy)
    yield from _over_time(analysis)
    yield from _dead_bands(analysis)
    for artefact in analysis.artefacts:
        spans = [f"{start:.2f} to {stop:.2f} s" for start, stop in artefact.spans_s[:_SPANS]]
        more = len(artefact.spans_s) - _SPANS
        times = ", ".join(spans) + (f" and {more} more" if more > 0 else "")
        note = f" ({artefact.note})" if artefact.note else ""
        where = f"{artefact.quantity} on {artefact.topic}" if artefact.topic else artefact.quantity
        about = f"{plain(artefact.joint)}, {where}: {artefact.flag}{note}"
        yield f"{_ABOUT[artefact.about]}: {about}{': ' if times else ''}{times}"


def _dead_bands(analysis: Analysis) -> Iterator[str]:
    """Yield a line for each joint with stick or play: its dead band at both reversals."""
    for joint in analysis.joints:
        band = joint.dead_band
        if band is None:
            continue
        ends = [
            (
                Estimate(reversal.travel_rad, reversal.travel_ci95),
                Estimate(reversal.step_rad, reversal.step_ci95),
            )
            for reversal in (band.top, band.bottom)
        ]
        ends = ends[:1] if ends[0] == ends[1] else ends
        widths = ", ".join(
            formats.estimate(formats.degrees(travel), "°", most=2) for travel, _ in ends
        )
        steps = ", ".join(formats.estimate(formats.degrees(step), "°", most=2) for _, step in ends)
        where = "both reversals" if len(ends) == 1 else "its upper and lower reversal"
        lag = math.degrees(band.lag_change_rad)
        yield (
            f"Dead band: {plain(joint.name)}, {band.kind} ({band.evidence}): at {where} "
            f"the command travels {widths} before the joint moves and catches up by {steps}; "
            f"of gain and lag the dead band alone makes {band.gain_change:.3f} and {lag:.1f}°"
        )


def _energy(energy: EnergyResult) -> Iterator[str]:
    cost = energy.transport
    named = (("E_net", cost.net), ("E_abs", cost.abs), ("E_el", cost.el))
    if costs := [
        f"{name} {formats.estimate(estimate, most=4)}" for name, estimate in named if estimate.value
    ]:
        way = formats.estimate(cost.distance_m, " m", most=3)
        yield f"Cost of transport E/(m g d): {', '.join(costs)}, over {way}"
    if energy.unknown is not None:
        yield formats.sentence(energy.unknown)
    closure = energy.closure
    if closure is not None and closure.mechanical_balance is not None:
        parts = [f"balance {100 * closure.mechanical_balance:.3f} %"]
        parts += [] if closure.net is None else [f"E_net {100 * closure.net:.2f} %"]
        parts += [] if closure.el is None else [f"E_el {100 * closure.el:.2f} %"]
        yield f"Against the twin's ledger, in % of E_abs: {', '.join(parts)}"


def _over_time(analysis: Analysis) -> Iterator[str]:
    """Yield the range of gain and lag over cycles if there is no single gait."""
    if analysis.over_time is None or analysis.gait.frequency_hz.value is not None:
        return
    cycles = [
        (gain, lag, rate)
        for joint in analysis.over_time.joints
        for gain, lag, rate in zip(joint.gain, joint.lag_rad, joint.frequency_hz, strict=True)
        if gain is not None and lag is not None
    ]
    gains, lags, rates = (sorted(cycle[k] for cycle in cycles) for k in range(3))
    low, high = (formats.degrees(Estimate(lag)).value for lag in (lags[0], lags[-1]))
    yield (
        f"Cycle by cycle, by the logged phase: {len(analysis.over_time.joints)} joints, gain "
        f"{formats.number(gains[0], 2)} to {formats.number(gains[-1], 2)}, lag "
        f"{formats.number(low, 1)} to {formats.number(high, 1)}°, {rates[0]:.2f} to "
        f"{rates[-1]:.2f} Hz (--json has each)"
    )


def chain_detail(chain: ChainCoupling) -> Iterable[str]:
    """Yield sentences on a chain of oscillators, the answer first."""
    where = f"Oscillators, {chain.plane}:"
    if not chain.identifiable:
        record = f" To decide it, record {chain.record}." if chain.record else ""
        yield f"{where} coupling not identifiable: {chain.why}.{record}"
        return
    number = chain.condition_number
    condition = formats.MISSING if number is None else f"{number:.3g}"
    strongest = max(chain.links, key=lambda link: link.K.value or 0.0)
    yield (
        f"{where} {len(chain.links)} couplings identified (condition number {condition}); "
        f"the strongest is {strongest.source} on {strongest.target}, "
        f"K = {formats.estimate(strongest.K, ' 1/s')}."
    )
    couplings = [
        f"{link.source} on {link.target} {formats.estimate(link.K)}" for link in chain.links
    ]
    yield f"K [1/s]: {'; '.join(couplings)}."
    if fed := [
        oscillator for oscillator in chain.oscillators if oscillator.feedback.value is not None
    ]:
        values = ", ".join(
            f"{oscillator.name} {formats.estimate(oscillator.feedback)}" for oscillator in fed
        )
        yield f"Feedback of each servo's own angle [1/s]: {values}."
    yield f"Method: {chain.why}, {chain.duration_s:.3g} s of phases."


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
        shown.append(tables.body_table(analysis.body))
    if any(index.value is not None for index in analysis.heterogeneity.values()):
        shown.append(tables.index_table(analysis.heterogeneity))
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


def shape_lines(shape: BodyShape | None) -> Iterator[str]:
    """Yield a sentence for each plane, and one on the travel of a cycle."""
    if shape is None:
        return
    for plane in shape.planes:
        yield _plane_line(plane)
    travel = shape.travel
    if travel is not None:
        yield (
            f"Travel of a cycle: {_mm(travel.forward_m)} forward, {_mm(travel.left_m)} to the "
            f"left, turn {_degrees(travel.turn_rad)} (virtual chassis; the links are "
            f"{1000 * travel.length_m:.0f} mm along and {1000 * travel.width_m:.0f} mm across from "
            "their mean, root mean square)."
        )


def contact_lines(contact: GroundContact | None) -> Iterator[str]:
    """Yield a sentence on which links are on the ground, where they are lifted."""
    if contact is None:
        return
    links = sorted(contact.links, key=lambda link: link.share.value or 0.0)
    mean = sum(link.share.value or 0.0 for link in links) / len(links)
    if mean > _LIFTED:
        return
    least, most = (f"{_percent(link.share)} ({link.link})" for link in (links[0], links[-1]))
    right = " to ".join(f"{100 * accuracy:.0f}" for accuracy in contact.twin_accuracy)
    yield (
        f"Ground contact, from the joints' {contact.source}: links are on the ground {least} to "
        f"{most} of a cycle, {100 * mean:.0f} % on the mean. In the twin contact and lift are "
        f"recognised in {right} %, by the gait (chance: 50 %)."
    )


def _plane_line(plane: PlaneShape) -> str:
    curve = plane.serpenoid
    where = "" if plane.plane is None else f", {plane.plane}"
    shares = ", ".join(_percent(mode.share) for mode in plane.modes)
    speed = formats.estimate(curve.speed, " joints/s", most=2)
    if curve.speed_m_s.value is not None:
        speed += f" ({formats.estimate(curve.speed_m_s, ' m/s', most=3)})"
    return (
        f"Body shape{where}: modes with {shares} of the variance; serpenoid of "
        f"{_degrees(curve.amplitude_rad)}, {_degrees(curve.wave_number)} a joint, "
        f"{formats.estimate(curve.waves, most=3)} waves at {speed}, offset "
        f"{_degrees(curve.offset_rad)}, leaves {_percent(curve.unexplained)} unexplained."
    )


def _mm(metres: Estimate) -> str:
    return formats.estimate(formats.scaled(metres, 1000.0), " mm", most=2)


def _degrees(angle: Estimate) -> str:
    return formats.estimate(formats.degrees(angle), "°", most=2)


def _percent(share: Estimate) -> str:
    return formats.estimate(formats.scaled(share, 100.0), " %", most=2)
