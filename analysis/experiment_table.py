"""An experiment as text for a terminal: the answer first, then mirror pairs and runs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from . import formats
from .experiment_answer import percent, told_p
from .kick_answer import kick_detail
from .result import Estimate
from .result_coupling import LocalCoupling
from .result_experiment import Experiment, Reversal
from .reversal_modules import SIGNIFICANT
from .table import UNLIMITED, sheet

if TYPE_CHECKING:
    from rich.table import Table


def render_experiment(
    experiment: Experiment, *, width: int = UNLIMITED, color: bool = False
) -> str:
    """Set an experiment as text.

    Args:
        experiment: The result.
        width: Columns of the terminal: sentences wrap there, but for the first line and the tables.
        color: Whether to use bold and dim type.

    Returns:
        Several lines, the last one ended.
    """
    text, prose, wide = sheet(width, color=color)
    count = len(experiment.sessions)
    wide.print(
        f"{count} session{'s' if count > 1 else ''}: {experiment.answer}.",
        style="bold",
        markup=False,
    )
    reversal = experiment.reversal
    if reversal is not None:
        for line in _detail(reversal):
            prose.print(line, markup=False)
        prose.print()
        wide.print(_joint_table(reversal))
    if isinstance(experiment.coupling, LocalCoupling):
        for line in kick_detail(experiment.coupling):
            prose.print(line, markup=False)
    prose.print()
    wide.print(_run_table(experiment))
    prose.print()
    for warning in experiment.warnings:
        prose.print(f"Warning: {warning}", markup=False)
    for warning, names in _by_warning(experiment):
        prose.print(f"Warning: {warning} ({names})", markup=False)
    coupling = experiment.coupling
    if not coupling.identifiable:
        record = f" To identify it, record {coupling.record}." if coupling.record else ""
        prose.print(f"Coupling: not identifiable: {coupling.why}.{record}", markup=False)
    method = _kick_method(coupling) if isinstance(coupling, LocalCoupling) else _method(reversal)
    prose.print(method, style="dim", markup=False)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def _detail(reversal: Reversal) -> Iterable[str]:
    for weak in reversal.weak:
        yield (
            f"{weak.name} against its mirror {weak.mirror}, over both directions: "
            f"{_gain(weak.log_gain_contrast)} in gain, {_lag(weak.lag_contrast_rad)} in lag "
            f"({told_p(weak.p)}, named by {weak.by})."
        )
    shares = (reversal.module_share, reversal.boundary_share)
    if shares[0].value is not None:
        yield (
            f"Spread over the joints: modules {percent(shares[0])}, boundary {percent(shares[1])}."
        )
    if max(reversal.equivalence_gain_p, reversal.equivalence_lag_p) < SIGNIFICANT:
        yield "Shown to be alike: every mirror pair within 2 % and 1°."
    yield f"The test is {reversal.blind}."


def _relative(log_gain: Estimate) -> Estimate:
    """Gain over gain, less one, in percent."""
    value, ci95 = log_gain.value, log_gain.ci95
    return Estimate(
        None if value is None else 100 * math.expm1(value),
        None if ci95 is None else (100 * math.expm1(ci95[0]), 100 * math.expm1(ci95[1])),
    )


def _gain(log_gain: Estimate) -> str:
    return formats.estimate(_relative(log_gain), " %", most=2)


def _lag(lag_rad: Estimate) -> str:
    return formats.estimate(formats.degrees(lag_rad), "°", most=2)


def _joint_table(reversal: Reversal) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("joint", "its mirror"):
        table.add_column(name, no_wrap=True)
    for name in ("gain % (95 %)", "lag° (95 %)", "p"):
        table.add_column(name, justify="right", no_wrap=True)
    gains = [_relative(one.log_gain_difference) for one in reversal.joints]
    lags = [formats.degrees(one.lag_difference_rad) for one in reversal.joints]
    digits = [formats.decimals_for(column, most=3) for column in (gains, lags)]
    for one, *pair in zip(reversal.joints, gains, lags, strict=True):
        cells = [
            f"{formats.number(q.value, d)} {formats.interval(q.ci95, d)}".rstrip()
            for q, d in zip(pair, digits, strict=True)
        ]
        table.add_row(escape(one.name), escape(one.mirror), *cells, formats.p_value(one.p))
    return table


def _run_table(experiment: Experiment) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("session", "wave"):
        table.add_column(name, no_wrap=True)
    table.add_column("Hz", justify="right", no_wrap=True)
    table.add_column("role", no_wrap=True)
    for run, session in zip(experiment.runs, experiment.sessions, strict=True):
        table.add_row(
            escape(formats.plain(Path(run.path).name)),
            run.wave or formats.MISSING,
            formats.number(session.gait.frequency_hz.value, 3),
            run.role or "left out",
        )
    return table


def _by_warning(experiment: Experiment) -> list[tuple[str, str]]:
    """The sessions' own warnings, each once; what the experiment itself answers is left out."""
    said: dict[str, list[str]] = {}
    for session in experiment.sessions:
        for warning in session.warnings:
            if not warning.startswith("boundary or module:"):
                said.setdefault(warning, []).append(Path(session.session.path).name)
    everyone = len(experiment.sessions)
    return [
        (warning, "all sessions" if len(names) == everyone else ", ".join(names))
        for warning, names in said.items()
    ]


def _kick_method(coupling: LocalCoupling) -> str:
    return (
        f"Method: local kicks, {coupling.kicked_runs} runs around {coupling.base_runs} without a "
        "kick: central differences of each joint's phase and log amplitude, intervals one by one "
        "at 95 % from the responses' noise (Student's t), those of indices at least 95 %; all four "
        "matrices with --json."
    )


def _method(reversal: Reversal | None) -> str:
    if reversal is None:
        return "Method: each session by itself as undulog analyse gives it; nothing is pooled."
    tried = (
        f"all {reversal.labellings}"
        if reversal.labellings_tried == reversal.labellings
        else f"{reversal.labellings_tried} random ones of {reversal.labellings}"
    )
    return (
        f"Method: reversal, {reversal.forward_runs} + {reversal.reverse_runs} runs: each joint "
        "with the wave from head to tail minus its mirror joint with the wave from tail to head; "
        f"largest studentised difference T = {formats.number(reversal.statistic, 2)}, its null by "
        f"dealing out the runs' labels anew ({tried}; p can't go below "
        f"{formats.number(reversal.p_floor, 4)}), family-wise over joints, gain and lag; intervals "
        "hold together at 95 %, those of shares by bootstrap over runs."
    )
