"""The result as text for a terminal: the answer first, then the joints, the method last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

from .result import Analysis, BodyResult, Estimate, Index, JointResult

if TYPE_CHECKING:
    from rich.table import Table

_MISSING = "–"
UNLIMITED = 10_000
"""A width at which nothing wraps."""


def render(analysis: Analysis, *, width: int = UNLIMITED, color: bool = False) -> str:
    """Set a result as text.

    Args:
        analysis: The result.
        width: Columns of the terminal: sentences wrap there, but for the first line and the tables.
        color: Whether to use bold and dim type.

    Returns:
        Several lines, the last one ended.
    """
    from rich.console import Console

    text = StringIO()

    def console(columns: int) -> Console:
        system = "standard" if color else None
        return Console(
            file=text, width=columns, color_system=system, force_terminal=color, highlight=False
        )

    prose, wide = console(max(width, 40)), console(UNLIMITED)
    wide.print(answer(analysis), style="bold", markup=False)
    tables = [_joint_table(analysis)]
    if analysis.body is not None:
        tables.append(_body_table(analysis.body))
    if any(one.value is not None for one in analysis.heterogeneity.values()):
        tables.append(_index_table(analysis.heterogeneity))
    for table in tables:
        prose.print()
        wide.print(table)
    prose.print()
    coupling = analysis.coupling
    if not coupling.identifiable:
        record = f" To identify it, record {coupling.record}." if coupling.record else ""
        prose.print(f"Coupling: not identifiable: {coupling.why}.{record}", markup=False)
    for warning in analysis.warnings:
        prose.print(f"Warning: {warning}", markup=False)
    prose.print(_method(analysis), style="dim", markup=False)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def answer(analysis: Analysis) -> str:
    """The result in one sentence.

    Args:
        analysis: The result.

    Returns:
        E.g. ``run.mcap: 13 of 25 joints follow a gait of 0.5000 Hz; lag 7.5 to 13.7 degrees, ...``.
    """
    name = Path(analysis.session.path).name
    if analysis.gait.frequency_hz.value is None:
        return f"{name}: no gait, so no gain and no lag; see the warnings."
    rhythm = f"a gait of {analysis.gait.frequency_hz.value:.4g} Hz"
    known = [joint for joint in analysis.joints if joint.lag_rad.value is not None]
    if not known:
        return f"{name}: {rhythm}, but no joint's gain and lag; see the warnings."
    lags = [math.degrees(joint.lag_rad.value or 0.0) for joint in known]
    gains = [joint.gain.value or 0.0 for joint in known]
    spread = ""
    tests = [
        i.p
        for n, i in analysis.heterogeneity.items()
        if n.startswith("common_") and i.p is not None
    ]
    if tests:
        p = min(1.0, min(tests) * len(tests))
        alike = "the joints differ" if p < 0.05 else "no difference between joints is shown"
        spread = f"; {alike} ({_p(p)})"
    return (
        f"{name}: {len(known)} of {len(analysis.joints)} joints follow {rhythm}; lag "
        f"{_range(lags, 1)} degrees, gain {_range(gains, 3)}{spread}."
    )


def _range(values: Sequence[float], decimals: int) -> str:
    low, high = f"{min(values):.{decimals}f}", f"{max(values):.{decimals}f}"
    return low if low == high else f"{low} to {high}"


def _p(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _estimate(estimate: Estimate, decimals: int, scale: float = 1.0) -> str:
    if estimate.value is None:
        return _MISSING
    text = f"{estimate.value * scale:.{decimals}f}"
    if estimate.ci95 is None:
        return text
    low, high = (f"{end * scale:.{decimals}f}" for end in estimate.ci95)
    return f"{text} [{low}, {high}]"


def _decimals(estimates: Sequence[Estimate], scale: float = 1.0) -> int:
    """Digits that show the narrowest interval with two figures, 1 to 5."""
    widths = [(e.ci95[1] - e.ci95[0]) * scale / 2 for e in estimates if e.ci95 is not None]
    narrow = min((w for w in widths if w > 0), default=0.0)
    return 3 if narrow == 0 else min(5, max(1, 1 - math.floor(math.log10(narrow))))


def _energy(value: float | None) -> str:
    return _MISSING if value is None else f"{value:.4f}".replace("-0.0000", "0.0000")


def _joint_table(analysis: Analysis) -> Table:
    from rich.table import Table

    joints = analysis.joints
    energies: list[tuple[str, list[float | None]]] = [
        ("E_net", [j.energy_net_j for j in joints]),
        ("E_plus", [j.energy_plus_j for j in joints]),
        ("E_abs", [j.energy_abs_j for j in joints]),
        ("E_el", [j.energy_el_j for j in joints]),
        ("E_el clipped", [j.energy_el_clipped_j for j in joints]),
    ]
    shown = [(name, values) for name, values in energies if any(v is not None for v in values)]
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("joint", no_wrap=True)
    table.add_column("plane", no_wrap=True)
    for name in ("command (deg)", "gain (95 %)", "lag (deg, 95 %)"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, _ in shown:
        table.add_column(f"{name} (J)", justify="right", no_wrap=True)
    table.add_column("cover", justify="right", no_wrap=True)
    table.add_column("flags")
    degree = math.degrees(1)
    gain_digits = _decimals([j.gain for j in joints])
    lag_digits = _decimals([j.lag_rad for j in joints], degree)
    for k, joint in enumerate(joints):
        table.add_row(
            *_names(joint),
            _MISSING
            if joint.command_amplitude_rad is None
            else f"{math.degrees(joint.command_amplitude_rad):.2f}",
            _estimate(joint.gain, gain_digits),
            _estimate(joint.lag_rad, lag_digits, degree),
            *(_energy(values[k]) for _, values in shown),
            f"{100 * joint.coverage:.1f}%",
            " ".join(joint.flags),
        )
    return table


def _names(joint: JointResult) -> tuple[str, str]:
    from rich.markup import escape

    return escape(joint.name), joint.plane or _MISSING


def _body_table(body: BodyResult) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column(f"body, {body.plane}", no_wrap=True)
    table.add_column("link", no_wrap=True)
    for name in ("seen (mm, 95 %)", "phase (deg, 95 %)"):
        table.add_column(name, justify="right", no_wrap=True)
    for name in body.null:
        table.add_column(f"{name} null (mm)", justify="right", no_wrap=True)
        table.add_column("phase (deg)", justify="right", no_wrap=True)
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
            "deg" if angle else index.unit,
            _MISSING if index.p is None else _p(index.p),
            index.label,
        )
    return table


def _method(analysis: Analysis) -> str:
    spans = ", ".join(f"{w.start_s:.2f} to {w.stop_s:.2f} s" for w in analysis.gait.windows)
    cycles = sum(w.cycles for w in analysis.gait.windows)
    if analysis.gait.frequency_hz.value is None:
        return f"Method: energies integrated on the samples' own times over {spans}."
    fitted = analysis.gait.fitted
    span = "" if fitted is None else f" of {fitted.start_s:.2f} to {fitted.stop_s:.2f} s"
    rhythm = _estimate(analysis.gait.frequency_hz, 6)
    return (
        f"Method: harmonic least squares{span} on each sample's own time, one frequency for all "
        f"joints: {rhythm} Hz; 95 % intervals from the residual's spectrum beside it, Student's t; "
        f"lag positive = response late; energies over {cycles:.0f} whole cycles, {spans}."
    )
