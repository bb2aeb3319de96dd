"""A layout of PlotJuggler that plots command and state of each joint of a session.

PlotJuggler finds a joint by its name, as ``/joint_states/joint01/position``.

Format: https://github.com/facontidavide/PlotJuggler.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from ...common.console import plain
from ...common.errors import DataError, some_names
from ...common.files import check_output, check_stop, write_text
from ...common.process import StopRequest
from ..joint_plots import JointPlot, joint_plots, plots_report, tab_title, tabs
from ..reports import ExportReport
from .format import DirectWriter, Format, not_read


def export_plotjuggler_layout(
    source: Path,
    output: Path,
    *,
    topics: Sequence[str] = (),
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write a layout for PlotJuggler; as for Foxglove.

    Args:
        output: A name that ends in .xml.
        topics: JointState topics; commands and states if none.
        force: Replace the file if it exists.
        stop: Ends the export, with nothing left behind.
    """
    check_output(output, (".xml",), "end the name of this layout in .xml", force=force)
    plots, duration_s, warnings = joint_plots(source, output, topics)
    named = [plot for plot in plots if plain(plot.joint) == plot.joint]
    if odd := [plot.joint for plot in plots if plot not in named]:
        warnings.append(f"names that XML can't hold, left out: {some_names(odd, 10)}")
    if not named:
        raise DataError(f"{source}: XML can't hold the names of its joints")
    check_stop(output, stop)
    write_text(output, plotjuggler_layout(named, duration_s))
    return plots_report(named, warnings)


def plotjuggler_layout(plots: Sequence[JointPlot], duration_s: float) -> str:
    """Return the layout of some joints as the text of an XML file.

    Args:
        duration_s: Length of the time axes [s].
    """
    root = ET.Element("root")
    names = {"name": "Main Window", "parent": "main_window"}
    window = ET.SubElement(root, "tabbed_widget", names)
    for group in tabs(plots):
        tab = ET.SubElement(window, "Tab", tab_name=tab_title(group), containers="1")
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


FORMAT = Format(
    "plotjuggler-layout", "layout of PlotJuggler", (".xml",), not_read,
    write=DirectWriter(export_plotjuggler_layout, "has plots", ("topics",)),
)  # fmt: skip
