"""Prepare comparisons for the page: of two sides, and of a fleet over weeks."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import quote

import matplotlib.dates
import numpy as np
import pandas as pd

from undulog.capture.common.palette import joint_hex

from ..catalog.earlier import departure_sentence
from ..catalog.fleet import QUANTITIES, Fleet, JointChange, RobotHistory
from ..catalog.fleet import sentence as change_sentence
from ..common import formats
from ..common.estimate import Estimate
from ..common.formats import estimate, scaled, short
from ..compare.decisions import RESPONSE, SIGNIFICANT_DIFFERENCE, WORDS
from ..compare.words import margin_text, signed_difference
from ..results.comparison import BODY, Comparison, of_body
from .page_tables import Fact, Trial, joint_mark
from .svg import (
    COMMAND,
    DASHED,
    MUTED,
    REFERENCE,
    Axes,
    Drawing,
    band,
    drawing,
    inline_svg,
    joint_ticks,
    key,
    legend,
    plot_estimate,
)
from .text_experiment import comparison_method

_MOST_WAVES = 4
"""Joints drawn: those whose cycles differ most."""

_VERDICTS = {
    "different": "different",
    "small": "different, but within the margins",
    "same": "the same within the margins",
    "open": "open",
}

_DATES: Any = matplotlib.dates  # whose annotations leave arguments unknown
_MOST_FIGURES = 6

_SPREADS = {"lag": (math.degrees(1), "°"), "offset": (math.degrees(1), "°"), "delay": (1e3, " ms")}
"""Factor and unit of quantities that are no ratios."""


class Panel(NamedTuple):
    """One quantity: its label with unit, the joints' values in that unit, and its margin."""

    label: str
    values: Sequence[Estimate]
    margin: float


def differences_drawing(
    names: Sequence[str], panels: Sequence[Panel], *, title: str, prefix: str
) -> Drawing:
    """Draw the differences of every joint, head to tail, one panel a quantity.

    Args:
        prefix: For identifiers, unique in the page.
    """
    colors = joint_hex(len(names))
    tooltips: dict[str, str] = {}
    with drawing(0.8 + 1.6 * len(panels)) as figure:
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
        for row, panel in enumerate(panels):
            tooltips |= _panel(grid[row, 0], panel, names, colors)
        last: Axes = grid[-1, 0]
        joint_ticks(last, names)
        last.set_xlabel("joint, head on the left")
        figure.align_ylabels()
        difference = key(color=colors[len(colors) // 2], marker="o", label="difference, 95 %")
        legend(figure, difference, key(color=REFERENCE, linestyle=DASHED, label="margins"))
        labels = ", ".join(panel.label for panel in panels)
        svg = inline_svg(figure, prefix, title, f"{len(names)} joints; panels: {labels}.", tooltips)
    return Drawing(svg, f"{title}. The intervals hold together at 95 %; dashed: the margins.")


def _panel(axes: Axes, panel: Panel, names: Sequence[str], colors: Sequence[str]) -> dict[str, str]:
    """Draw a quantity; returns the texts of its values by the identifiers of their groups."""
    tooltips: dict[str, str] = {}
    quantity, _, unit = panel.label.rstrip("]").partition(" [")
    unit = unit if unit.startswith("°") else f" {unit}"
    axes.axhline(0.0, color=REFERENCE, linewidth=0.8, zorder=1)
    for margin in (-panel.margin, panel.margin):
        axes.axhline(margin, color=REFERENCE, linestyle=DASHED, linewidth=0.8, zorder=1)
    for place, (value, name, color) in enumerate(
        zip(panel.values, names, colors, strict=True), start=1
    ):
        if value.value is not None:
            gid = f"{quantity}-{place}"
            plot_estimate(axes, place, value, color, gid=gid)
            tooltips[gid] = f"{name}: difference of {quantity} {estimate(value, unit)}"
    axes.set_ylabel(panel.label)
    axes.margins(y=0.15)
    return tooltips


def waveforms_drawing(comparison: Comparison, prefix: str) -> Drawing:
    """Draw the mean cycles that differ most: both sides on the left, B minus A on the right.

    Args:
        comparison: With at least one waveform.
        prefix: For identifiers, unique in the page.
    """
    every = joint_hex(len(comparison.waveforms))
    worst = sorted(comparison.waveforms, key=lambda waveform: -waveform.rms_rad)[:_MOST_WAVES]
    pairs = zip(comparison.waveforms, every, strict=True)
    shown = [(waveform, color) for waveform, color in pairs if waveform in worst]
    phases = np.degrees(comparison.phase_rad)
    phase = "gait phase" if comparison.commanded else "phase"
    tooltips: dict[str, str] = {}
    with drawing(0.8 + 1.4 * len(shown)) as figure:
        grid = figure.subplots(len(shown), 2, sharex=True, squeeze=False)
        for k, ((both, right), (waveform, color)) in enumerate(zip(grid, shown, strict=True)):
            both.plot(phases, np.degrees(waveform.a_rad), gid=f"a-{k}", **COMMAND)
            both.plot(phases, np.degrees(waveform.b_rad), color=color, gid=f"b-{k}")
            both.set_title(short(waveform.name))
            middle, half = np.degrees(waveform.difference_rad), np.degrees(waveform.half_rad)
            right.axhline(0.0, color=REFERENCE, linestyle=DASHED, linewidth=0.8)
            band(right, phases, middle - half, middle + half, color=color, alpha=0.25)
            right.plot(phases, middle, color=color, gid=f"difference-{k}")
            names = {"a": "A", "b": "B", "difference": "B − A"}
            tooltips |= {f"{which}-{k}": f"{waveform.name} {name}" for which, name in names.items()}
            right.set_title("B − A")
        grid[-1, 0].set_xticks(range(0, 361, 90))
        for axes in grid[-1]:
            axes.set_xlabel(f"{phase} [°]")
        figure.supylabel("joint angle [°]", fontsize=8.0)
        color = shown[0][1]
        legend(
            figure,
            key(label="A", **COMMAND),
            key(color=color, label="B"),
            key(color=color, linewidth=6, alpha=0.25, label="95 %, each phase"),
        )
        description = "Joints: " + ", ".join(short(waveform.name) for waveform, _ in shown) + "."
        svg = inline_svg(figure, prefix, f"Mean cycles by {phase}", description, tooltips)
    by = "commands" if comparison.commanded else "first joint's own motion"
    return Drawing(
        svg,
        f"Mean cycle of the joints that differ most, by the phase of the {by}: A dashed, B in "
        "the joint's colour, and their difference with its 95 % interval at each phase.",
    )


def comparison_view(comparison: Comparison) -> dict[str, Any]:
    """Return what the template shows of a comparison, by name."""
    sides = (("A", comparison.a), ("B", comparison.b))
    names = joints_of(comparison)
    colors = dict(zip(names, joint_hex(len(names)), strict=True)) if names else {}
    return {
        "comparison": comparison,
        "sentence": comparison.answer,
        "sides": [(letter, session) for letter, sessions in sides for session in sessions],
        "facts": _facts(comparison),
        "marks": [joint_mark(colors[joint.name], "horizontal") for joint in comparison.named],
        "differences": differences_of(comparison, "differences") if names else None,
        "waveforms": waveforms_drawing(comparison, "waveforms") if comparison.waveforms else None,
        "trials": _trials(comparison),
        "method": comparison_method(comparison),
    }


def joints_of(comparison: Comparison) -> list[str]:
    """Return the names of the compared joints, head to tail if known from their mean cycles."""
    return [waveform.name for waveform in comparison.waveforms] or sorted(
        {
            difference.place
            for difference in comparison.differences
            if difference.quantity in ("gain", "amplitude")
        }
    )


def differences_of(comparison: Comparison, prefix: str) -> Drawing:
    """Draw the differences of every joint in gain, lag and energy, one panel each.

    Without commands, in amplitude and phase lag instead of gain and lag.

    Args:
        comparison: With at least one joint.
        prefix: For identifiers, unique in the page.
    """
    names = joints_of(comparison)
    differences = {
        (difference.quantity, difference.place): difference.difference
        for difference in comparison.differences
    }
    margins = {test.quantity: test.margin for test in comparison.equivalence}
    panels: list[Panel] = []
    for quantity, label, factor in (
        ("gain", "gain [%]", 100.0),
        ("lag", "lag [°]", math.degrees(1)),
        ("delay", "lag [ms]", 1000.0),
        ("offset", "offset [°]", math.degrees(1)),
        ("amplitude", "amplitude [%]", 100.0),
        ("phase_lag", "phase lag [°]", math.degrees(1)),
        ("energy_abs", "E_abs [mJ a cycle]", 1000.0),
    ):
        if quantity in margins:
            values = [
                scaled(differences.get((quantity, name), Estimate()), factor) for name in names
            ]
            panels.append(Panel(label, values, factor * margins[quantity]))
    return differences_drawing(names, panels, title="B minus A of every joint", prefix=prefix)


def _trials(comparison: Comparison) -> list[Trial]:
    return [
        Trial(
            f"Is the {WORDS[test.quantity]} the same on both sides, within {margin_text(test)}?",
            f"largest difference {margin_text(test, test.largest)}",
            test.p,
            "yes, shown to be the same" if test.p < SIGNIFICANT_DIFFERENCE else "not shown",
        )
        for test in comparison.equivalence
    ]


def _facts(comparison: Comparison) -> list[Fact]:
    a, b = len(comparison.a), len(comparison.b)
    joints = len(joints_of(comparison))
    compared = {difference.quantity for difference in comparison.differences}
    quantities = [quantity for quantity in RESPONSE if quantity in compared]
    quantities = [quantity for quantity in quantities if quantity != "rest_amplitude"]
    responses = " or ".join(dict.fromkeys(WORDS[quantity] for quantity in quantities))
    quantities += ["offset"] if "offset" in compared else []
    facts = [
        Fact("Verdict", _VERDICTS[comparison.verdict], "all quantities together, Holm at 5 %"),
        Fact("Sessions", f"{a} and {b}", "on side A and B"),
        Fact("Joints that differ", f"{len(comparison.named)} of {joints}", f"in {responses}"),
    ]
    for quantity in quantities:
        of = [
            difference for difference in comparison.differences if difference.quantity == quantity
        ]
        if of:
            worst = max(of, key=lambda difference: difference.size)
            text = signed_difference(worst)
            facts.append(Fact(f"Largest in {WORDS[quantity]}", text, f"B minus A, {worst.place}"))
    for difference in comparison.differences:
        if of_body(difference.place):
            text = signed_difference(difference)
            point = difference.place[len(BODY) + 2 :]
            title = f"{point} {WORDS[difference.quantity]}".strip().capitalize()
            facts.append(Fact(title, text, "B minus A"))
    return facts


def fleet_view(fleet: Fleet, joints: pd.DataFrame, where: str, page: Path) -> dict[str, Any]:
    """Return what the template shows of a fleet, by name.

    Args:
        joints: Rows of the view ``joints`` that the fleet was computed from.
        where: Folder or URL of the sessions.
        page: Where the page goes: links start there.
    """
    return {
        "fleet": fleet,
        "where": where,
        "departures": [departure_sentence(departure) for departure in fleet.departures],
        "warnings": [*fleet.warnings, *(w for h in fleet.robots for w in h.warnings)],
        "contents": [
            (f"robot{k}", h.label or "Robot without a name")
            for k, h in enumerate(fleet.robots, start=1)
        ],
        "command": f"undulog report --catalog {shlex.quote(where)} -o {shlex.quote(page.name)}",
        "robots": [
            {
                "history": history,
                "facts": _fleet_facts(history),
                "links": {
                    outlier.path: _links(outlier.path, where, page) for outlier in history.outliers
                },
                "figures": [
                    _change_drawing(history, change, joints, f"change-{k}-{n}")
                    for n, change in enumerate(history.changes[:_MOST_FIGURES])
                ],
            }
            for k, history in enumerate(fleet.robots)
        ],
    }


def spread_text(quantity: str, value: float | None) -> str:
    """Return a standard deviation as people read it: degrees, milliseconds, or percent."""
    if value is None:
        return formats.number(None, 0)
    factor, unit = _SPREADS.get(quantity, (100.0, " %"))
    return f"{formats.number(factor * value, 2)}{unit}"


def change_text(quantity: str, value: float) -> str:
    """Return a change or deviation as :func:`spread_text` does, with its sign."""
    return ("+" if value > 0 else "") + spread_text(quantity, value)


def _fleet_facts(history: RobotHistory) -> list[Fact]:
    return [
        Fact("sessions", str(history.sessions), f"{history.first[:10]} to {history.last[:10]}"),
        Fact("joints compared", str(len(history.joints)), ""),
        Fact("gaits", str(history.conditions), ""),
        Fact("changes", str(len(history.changes)), ""),
        Fact("outliers", str(len(history.outliers)), ""),
    ]


def _links(path: str, where: str, page: Path) -> Mapping[str, str]:
    """Return the addresses of a session and, where it lies beside it, of its page."""
    if "://" in where:
        return {"session": f"{where.rstrip('/')}/{quote(path)}", "page": ""}
    session = Path(where).resolve() / path
    beside = session.with_suffix(".html")
    base = page.resolve().parent
    return {
        "session": _relative(session, base),
        "page": _relative(beside, base) if beside.is_file() else "",
    }


def _relative(path: Path, base: Path) -> str:
    try:
        return quote(PurePosixPath(path.relative_to(base)).as_posix())
    except ValueError:
        return path.as_uri()


def _change_drawing(
    history: RobotHistory, change: JointChange, joints: pd.DataFrame, prefix: str
) -> Drawing:
    """Draw the values of a joint that changes over its sessions, the others behind it."""
    columns = {"lag": "lag_rad", "offset": "offset_rad", "energy": "energy_abs_j"}
    column = (columns | {"gain": "gain", "delay": "tracking_lag_s"})[change.quantity]
    table: Any = joints
    named = (table["robot"] == history.robot) & (table["serial"].fillna("") == history.serial)
    frame = table[named & table["joint"].isin(history.joints)]
    if change.quantity == "gain" and "tracking_gain" in frame:
        frame = frame.assign(gain=frame["gain"].fillna(frame["tracking_gain"]))
    frame = frame.dropna(subset=[column]).sort_values("start")
    degrees = change.quantity in ("lag", "offset")
    values = frame[column].map(math.degrees) if degrees else frame[column]
    if change.quantity == "energy":
        values /= frame["stop_s"] - frame["start_s"]
    colors = dict(zip(history.joints, joint_hex(len(history.joints)), strict=True))
    tooltips: dict[str, str | Sequence[str]] = {}
    with drawing(2.4) as figure:
        axes: Axes = figure.subplots()
        for name in history.joints:
            rows = frame["joint"] == name
            mine = name == change.joint
            axes.plot(
                frame["start"][rows].to_numpy(),
                values[rows].to_numpy(),
                color=colors[name] if mine else REFERENCE,
                marker="o" if mine else None,
                markersize=3,
                linewidth=1.2 if mine else 0.4,
                zorder=3 if mine else 1,
                gid="changed" if mine else None,
            )
            if mine:
                points = zip(frame["start"][rows], values[rows], frame["path"][rows], strict=True)
                texts = [f"{name}: {v:.4g} on {str(t)[:10]}, {path}" for t, v, path in points]
                tooltips["changed"] = texts
        axes.axvspan(
            pd.Timestamp(change.earliest), pd.Timestamp(change.latest), color=MUTED, alpha=0.25
        )
        axes.axvline(pd.Timestamp(change.date), color=MUTED, linestyle=DASHED, linewidth=0.8)
        label = QUANTITIES[change.quantity].replace("[rad]", "[°]")
        axes.set_ylabel(label)
        locator = _DATES.AutoDateLocator(maxticks=7)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(_DATES.ConciseDateFormatter(locator))
        legend(
            figure,
            key(color=colors[change.joint], marker="o", label=change.joint),
            key(color=REFERENCE, label="the other joints"),
            key(color=MUTED, linestyle=DASHED, label="change, 95 % interval"),
        )
        svg = inline_svg(figure, prefix, f"{change.joint} over the sessions", label, tooltips)
        return Drawing(svg, f"{change_sentence(change).capitalize()}.")
