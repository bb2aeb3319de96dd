"""Layouts of Foxglove and PlotJuggler that show command and state of each joint of a session.

Each joint has a plot of its own, with a curve a topic; tabs hold a few joints each.

Foxglove finds a joint by its place in the message, so that a joint whose place changes has no plot
there. PlotJuggler finds it by its name, as ``/joint_states/joint01/position``.

Formats: https://docs.foxglove.dev/docs/visualization/layouts,
https://github.com/facontidavide/PlotJuggler.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from ..bus.decoded_topics import JOINT_TOPIC
from ..common.console import plain
from ..common.errors import DataError, MissingChannelError, some_names
from ..common.files import check_output, check_stop, write_text
from ..common.process import StopRequest
from ..log.read.session import Session
from ..robot.model import Quantity
from .export import ExportReport

_PER_TAB = 6
_COLORS = ("#7f7f7f", "#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e")
_BARE_TOPIC = re.compile(r"[A-Za-z0-9_/-]+")


@dataclass(frozen=True)
class TopicCurve:
    """One topic's angles of a joint.

    Attributes:
        place: Where it is in each message, or None if that changes.
        low: Least value [rad].
        high: Largest value [rad].
    """

    topic: str
    place: int | None
    color: str
    low: float
    high: float


@dataclass(frozen=True)
class JointPlot:
    """The curves of a joint."""

    joint: str
    curves: tuple[TopicCurve, ...]


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
    plots, _, warnings = _plots(source, output, topics)
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
    return _report(shown, warnings)


def export_plotjuggler_layout(
    source: Path,
    output: Path,
    *,
    topics: Sequence[str] = (),
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write a layout for PlotJuggler; see :func:`export_foxglove_layout`.

    Args:
        output: A name that ends in .xml.
        topics: JointState topics; commands and states if none.
        force: Replace the file if it exists.
        stop: Ends the export, with nothing left behind.
    """
    check_output(output, (".xml",), "end the name of this layout in .xml", force=force)
    plots, duration_s, warnings = _plots(source, output, topics)
    named = [plot for plot in plots if plain(plot.joint) == plot.joint]
    if odd := [plot.joint for plot in plots if plot not in named]:
        warnings.append(f"names that XML can't hold, left out: {some_names(odd, 10)}")
    if not named:
        raise DataError(f"{source}: XML can't hold the names of its joints")
    check_stop(output, stop)
    write_text(output, plotjuggler_layout(named, duration_s))
    return _report(named, warnings)


def _report(plots: Sequence[JointPlot], warnings: list[str]) -> ExportReport:
    joints = [plot.joint for plot in plots]
    return ExportReport(f"plots of {len(joints)} joints", {"joints": joints}, warnings)


def _plots(
    source: Path, output: Path, topics: Sequence[str]
) -> tuple[list[JointPlot], float, list[str]]:
    """Return the plots of a session, its length [s], and the report to fill."""
    usual = [JOINT_TOPIC[Quantity.COMMAND], JOINT_TOPIC[Quantity.POSITION]]
    with Session.open(source, column_folder=output.parent) as session:
        plotted = list(dict.fromkeys(topics)) or [t for t in usual if t in session.channels]
        if not plotted:
            missing = " and no ".join(usual)
            raise MissingChannelError(source, missing, sorted(session.channels))
        read = session.joint_columns({topic: ["position"] for topic in plotted})
        curves: dict[str, list[TopicCurve]] = {}
        for number, topic in enumerate(plotted):
            signals = read[topic, "position"]
            places = _places(session.joint_orders(topic))
            color = _COLORS[number % len(_COLORS)]
            for joint, values in zip(signals.names, signals.values, strict=True):
                finite = values[np.isfinite(values)]
                low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0, 0)
                curve = TopicCurve(topic, places.get(joint), color, low, high)
                curves.setdefault(joint, []).append(curve)
        plots = [JointPlot(name, tuple(curve)) for name, curve in curves.items()]
        return plots, session.duration_s, session.warnings


def _places(orders: Sequence[tuple[str, ...]]) -> dict[str, int]:
    """Return the place of each joint in the messages of a topic, if it is the same in all."""
    first, *others = orders
    return {
        name: place
        for place, name in enumerate(first)
        if all(order[place : place + 1] == (name,) for order in others)
    }


def _groups(plots: Sequence[JointPlot]) -> Iterator[Sequence[JointPlot]]:
    """Yield the plots of each tab."""
    for start in range(0, len(plots), _PER_TAB):
        yield plots[start : start + _PER_TAB]


def foxglove_layout(plots: Sequence[JointPlot]) -> dict[str, Any]:
    """Return the layout of some joints as plain JSON values."""
    panels: dict[str, Any] = {}
    tabs: list[dict[str, Any]] = []
    for group in _groups(plots):
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
        tabs.append({"title": _title(group), "layout": _stacked(names)})
    panels["Tab!joints"] = {"activeTabIdx": 0, "tabs": tabs}
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


def _title(group: Sequence[JointPlot]) -> str:
    first, last = group[0].joint, group[-1].joint
    return first if first == last else f"{first} to {last}"


def plotjuggler_layout(plots: Sequence[JointPlot], duration_s: float) -> str:
    """Return the layout of some joints as the text of an XML file.

    Args:
        duration_s: Length of the time axes [s].
    """
    root = ET.Element("root")
    names = {"name": "Main Window", "parent": "main_window"}
    window = ET.SubElement(root, "tabbed_widget", names)
    for group in _groups(plots):
        tab = ET.SubElement(window, "Tab", tab_name=_title(group), containers="1")
        container = ET.SubElement(tab, "Container")
        sizes = ";".join([f"{1 / len(group):.6f}"] * len(group))
        split = {"orientation": "-", "sizes": sizes, "count": str(len(group))}
        splitter = ET.SubElement(container, "DockSplitter", split)
        for plot in group:
            area = ET.SubElement(splitter, "DockArea", name=f"{plot.joint} [rad]")
            area.append(_plot_element(plot, duration_s))
    ET.SubElement(window, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    ET.indent(root, " ")
    text = ET.tostring(root, encoding="unicode")
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n"


def _plot_element(plot: JointPlot, duration_s: float) -> ET.Element:
    style = {"style": "Lines", "mode": "TimeSeries", "flip_x": "false", "flip_y": "false"}
    element = ET.Element("plot", style)
    low, high = (min(c.low for c in plot.curves), max(c.high for c in plot.curves))
    margin = 0.05 * (high - low) or 0.1
    edges = {"left": 0.0, "right": duration_s, "top": high + margin, "bottom": low - margin}
    ET.SubElement(element, "range", {name: f"{edge:.6f}" for name, edge in edges.items()})
    ET.SubElement(element, "limitY")
    for curve in plot.curves:
        name = f"{curve.topic}/{plot.joint}/position"
        ET.SubElement(element, "curve", name=name, color=curve.color)
    return element
