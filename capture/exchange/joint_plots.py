"""Plots of command and state of each joint of a session, for the layouts of plotting tools.

Each joint has a plot of its own, with a curve a topic; tabs hold a few joints each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.errors import MissingChannelError
from ..robot.model import Quantity
from .reports import ExportReport

_PER_TAB = 6
_COLORS = ("#7f7f7f", "#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e")


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


def plots_report(plots: Sequence[JointPlot], warnings: list[str]) -> ExportReport:
    """Return the report of a layout."""
    joints = [plot.joint for plot in plots]
    return ExportReport(f"plots of {len(joints)} joints", {"joints": joints}, warnings)


def joint_plots(
    source: Path, output: Path, topics: Sequence[str]
) -> tuple[list[JointPlot], float, list[str]]:
    """Return the plots of a session, its length [s], and the report to fill."""
    from ..bus.decoded_topics import JOINT_TOPIC
    from ..log.read.session import Session

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


def tabs(plots: Sequence[JointPlot]) -> Iterator[Sequence[JointPlot]]:
    """Yield the plots of each tab."""
    for start in range(0, len(plots), _PER_TAB):
        yield plots[start : start + _PER_TAB]


def tab_title(group: Sequence[JointPlot]) -> str:
    """Return the name of a tab, by its joints."""
    first, last = group[0].joint, group[-1].joint
    return first if first == last else f"{first} to {last}"
