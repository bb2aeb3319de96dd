"""Prepare a fleet for the page."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import matplotlib.dates
import pandas as pd

from undulog.capture.common.palette import joint_hex

from ...catalog.fleet import QUANTITIES, Fleet, JointChange, RobotHistory
from ...catalog.fleet import sentence as change_sentence
from ...results import formats
from .svg import DASHED, MUTED, REFERENCE, Axes, Drawing, drawing, inline_svg, key, legend
from .tables import Fact

_DATES: Any = matplotlib.dates  # whose annotations leave arguments unknown
_MOST_FIGURES = 6


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
        "warnings": [*fleet.warnings, *(w for h in fleet.robots for w in h.warnings)],
        "contents": [
            (f"robot{k}", h.robot or "Robot without a name")
            for k, h in enumerate(fleet.robots, start=1)
        ],
        "command": f"undulog report --catalog {shlex.quote(where)} -o {shlex.quote(page.name)}",
        "robots": [
            {
                "history": history,
                "facts": _fleet_facts(history),
                "links": {one.path: _links(one.path, where, page) for one in history.outliers},
                "figures": [
                    _change_drawing(history, change, joints, f"change-{k}-{n}")
                    for n, change in enumerate(history.changes[:_MOST_FIGURES])
                ],
            }
            for k, history in enumerate(fleet.robots)
        ],
    }


def spread_text(quantity: str, value: float | None) -> str:
    """Return a standard deviation as people read it: degrees for lag, percent for the others."""
    if value is None:
        return formats.number(None, 0)
    return (
        f"{formats.number(math.degrees(value), 2)}°"
        if quantity == "lag"
        else f"{formats.number(100 * value, 2)} %"
    )


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
    column = {"gain": "gain", "lag": "lag_rad", "energy": "energy_abs_j"}[change.quantity]
    table: Any = joints
    own = table[(table["robot"] == history.robot) & table["joint"].isin(history.joints)]
    own = own.dropna(subset=[column]).sort_values("start")
    values = own[column].map(math.degrees) if change.quantity == "lag" else own[column]
    if change.quantity == "energy":
        values /= own["stop_s"] - own["start_s"]
    colors = dict(zip(history.joints, joint_hex(len(history.joints)), strict=True))
    tooltips: dict[str, str | Sequence[str]] = {}
    with drawing(2.4) as figure:
        axes: Axes = figure.subplots()
        for name in history.joints:
            rows = own["joint"] == name
            mine = name == change.joint
            axes.plot(
                own["start"][rows].to_numpy(),
                values[rows].to_numpy(),
                color=colors[name] if mine else REFERENCE,
                marker="o" if mine else None,
                markersize=3,
                linewidth=1.2 if mine else 0.4,
                zorder=3 if mine else 1,
                gid="changed" if mine else None,
            )
            if mine:
                points = zip(own["start"][rows], values[rows], own["path"][rows], strict=True)
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
