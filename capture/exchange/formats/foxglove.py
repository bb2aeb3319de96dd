"""A layout of Foxglove that plots command and state of each joint of a session.

Foxglove finds a joint by its place in the message, so that a joint whose place changes has no plot
there.

Format: https://docs.foxglove.dev/docs/visualization/layouts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...common.errors import DataError, some_names
from ...common.files import check_output, check_stop, write_text
from ...common.process import StopRequest
from ..joint_plots import JointPlot, joint_plots, plots_report, tab_title, tabs
from ..reports import ExportReport
from .format import DirectWriter, Format, not_read

_BARE_TOPIC = re.compile(r"[A-Za-z0-9_/-]+")


def export_foxglove_layout(
    source: Path,
    output: Path,
    *,
    topics: Sequence[str] = (),
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write a layout for Foxglove.

    Args:
        output: A name that ends in .json.
        topics: JointState topics; commands and states if none.
        force: Replace the file if it exists.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the name ends in anything else.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no such topic.
        DataError: If a topic is not of JointStates, or no joint can be shown.
        LogWriteError: If the output can't be written or the export was stopped.
    """
    check_output(output, (".json",), "end the name of this layout in .json", force=force)
    plots, _, warnings = joint_plots(source, output, topics)
    placed = [
        JointPlot(plot.joint, tuple(c for c in plot.curves if c.place is not None))
        for plot in plots
    ]
    if moving := [plot.joint for plot in plots if any(c.place is None for c in plot.curves)]:
        warnings.append(
            "Foxglove finds joints by their place in the message, which changes here, so these "
            f"have no curve: {some_names(moving, 10)}"
        )
    shown = [plot for plot in placed if plot.curves]
    if not shown:
        raise DataError(f"{source}: Foxglove can't show its joints, whose places change")
    check_stop(output, stop)
    write_text(output, json.dumps(foxglove_layout(shown), indent=2) + "\n")
    return plots_report(shown, warnings)


def foxglove_layout(plots: Sequence[JointPlot]) -> dict[str, Any]:
    """Return the layout of some joints as plain JSON values."""
    panels: dict[str, Any] = {}
    shown: list[dict[str, Any]] = []
    for group in tabs(plots):
        names: list[str] = []
        for plot in group:
            names.append(f"Plot!joint{len(panels) + 1}")
            panels[names[-1]] = {
                "title": f"{plot.joint} [rad]",
                "paths": [
                    {
                        "value": f"{_quoted(curve.topic)}.position[{curve.place}]",
                        "label": curve.topic.removeprefix("/"),
                        "color": curve.color,
                        "enabled": True,
                        "timestampMethod": "headerStamp",
                    }
                    for curve in plot.curves
                ],
                "showLegend": True,
                "legendDisplay": "floating",
                "showXAxisLabels": True,
                "showYAxisLabels": True,
                "isSynced": True,
                "xAxisVal": "timestamp",
            }
        shown.append({"title": tab_title(group), "layout": _stacked(names)})
    panels["Tab!joints"] = {"activeTabIdx": 0, "tabs": shown}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!joints",
    }


def _quoted(topic: str) -> str:
    return topic if _BARE_TOPIC.fullmatch(topic) else json.dumps(topic, ensure_ascii=False)


def _stacked(names: Sequence[str]) -> Any:
    """Return panels one above the other, of one height."""
    first, *rest = names
    if not rest:
        return first
    share = 100.0 / len(names)
    return {
        "direction": "column",
        "first": first,
        "second": _stacked(rest),
        "splitPercentage": share,
    }


FORMAT = Format(
    "foxglove-layout", "layout of Foxglove", (".json",), not_read,
    write=DirectWriter(export_foxglove_layout, "has plots", ("topics",)),
)  # fmt: skip
