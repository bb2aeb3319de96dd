"""What is wrong with samples, and when: rows with their place in the session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.console import plain
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.common.palette import joint_hex

from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.artefact import KINDS, Artefact, Span
from ...results.formats import degrees, estimate, short
from .svg import REFERENCE, WIDTH_IN, Axes, Drawing, drawing, inline_svg, key, legend, new_figure
from .tables import element, is_driven

CYCLES = 2.5
"""Gait cycles shown."""

SECONDS_WITHOUT_GAIT = 5.0
"""Shown where there is no gait [s]."""

MOST_POINTS = 600
"""Samples drawn a line; more would only add bytes, a figure is about 900 pixels wide."""


@dataclass(frozen=True)
class Trace:
    """Command and response of one joint over a stretch of the session.

    Attributes:
        joint: The joint's result.
        place: Its index in the chain, from 0 at the head.
        command_t_s: Sampling times of the command from the session's start [s], shape (n,).
        command_rad: [rad], shape (n,).
        response_t_s: Sampling times of the response from the session's start [s], shape (k,).
        response_rad: [rad], shape (k,).
    """

    joint: JointResult
    place: int
    command_t_s: FloatArray
    command_rad: FloatArray
    response_t_s: FloatArray
    response_rad: FloatArray


def chosen_joints(joints: Sequence[JointResult]) -> list[int]:
    """The joints to show: head, middle and tail end of the plane that is driven most.

    Returns:
        Up to three indices, ascending; all joints count where none is driven.
    """
    driven = [i for i, joint in enumerate(joints) if is_driven(joint)]
    planes = [joints[i].plane for i in driven]
    if driven:
        most = max(dict.fromkeys(planes), key=planes.count)
        members = [i for i in driven if joints[i].plane == most]
    else:
        members = list(range(len(joints)))
    if len(members) <= 3:
        return members
    return [members[0], members[len(members) // 2], members[-1]]


def stretch_s(analysis: Analysis) -> tuple[float, float]:
    """The stretch to show: the last cycles of the last analysed window.

    Args:
        analysis: With or without a gait.

    Returns:
        Start and stop from the session's start [s].
    """
    frequency = analysis.gait.frequency_hz.value
    length = CYCLES / frequency if frequency else SECONDS_WITHOUT_GAIT
    window = analysis.gait.windows[-1] if analysis.gait.windows else None
    stop = window.stop_s if window is not None else analysis.session.duration_s
    first = window.start_s if window is not None else 0.0
    return max(first, stop - length), stop


def read_traces(session: SessionView, analysis: Analysis) -> tuple[Trace, ...]:
    """Read what :func:`command_response` draws.

    Args:
        analysis: Of that session; its options say which topics were analysed.

    Returns:
        One trace a chosen joint; empty where a topic or all samples are missing.
    """
    options = analysis.provenance.options
    commands = str(options.get("command_topic") or "/joint_commands")
    states = str(options.get("response_topic") or "/joint_states")
    start_s, stop_s = stretch_s(analysis)
    start_ns = analysis.session.start_ns
    bounds = {
        "start_ns": start_ns + round(start_s * 1e9),
        "stop_ns": start_ns + round(stop_s * 1e9),
    }
    try:
        command = session.joints(commands, "position", **bounds)
        response = session.joints(states, "position", **bounds)
    except (MissingChannelError, DataError):
        return ()
    traces: list[Trace] = []
    for place in chosen_joints(analysis.joints):
        joint = analysis.joints[place]
        if joint.name not in response.names:
            continue
        columns: list[FloatArray] = []
        for signals in (command, response):
            if joint.name in signals.names:
                signal = signals.signal(joint.name)
                t_s: FloatArray = np.asarray((signal.t_ns - start_ns) * 1e-9, np.float64)
                columns += _thinned(t_s, signal.values)
            else:
                columns += [np.empty(0), np.empty(0)]
        if columns[3].size:
            traces.append(Trace(joint, place, *columns))
    return tuple(traces)


def _thinned(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Every k-th finite sample, k the least that keeps within ``MOST_POINTS``."""
    finite = np.isfinite(values)
    t_s, values = t_s[finite], values[finite]
    step = max(1, -(-len(t_s) // MOST_POINTS))
    return frozen(t_s[::step]), frozen(values[::step])


def command_response(traces: Sequence[Trace], joint_count: int, prefix: str) -> Drawing:
    """Command (grey) and response (coloured) of a few joints, one panel each.

    Args:
        joint_count: Joints in the chain, for their colours.
        prefix: For identifiers, unique in the page.

    Returns:
        The figure; angles in degrees.
    """
    colors = joint_hex(joint_count)
    with drawing():
        figure = new_figure(WIDTH_IN, 0.7 + 1.35 * len(traces))
        grid = figure.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)
        for k, trace in enumerate(traces):
            axes: Axes = grid[k, 0]
            axes.plot(
                trace.command_t_s, np.degrees(trace.command_rad), color=REFERENCE, linewidth=2.4
            )
            axes.plot(
                trace.response_t_s,
                np.degrees(trace.response_rad),
                color=colors[trace.place],
                linewidth=1.6,
            )
            axes.set_title(_panel_title(trace.joint))
            axes.margins(x=0.01)
        figure.supylabel("joint angle [°]", fontsize=8.0)
        grid[-1, 0].set_xlabel("time from the session's start [s]")
        handles = [
            key([], [], color=REFERENCE, linewidth=2.4, label="command"),
            key([], [], color=colors[traces[len(traces) // 2].place], label="response"),
        ]
        legend(figure, handles)
        svg = inline_svg(
            figure,
            prefix=prefix,
            title="Command and response of " + ", ".join(t.joint.name for t in traces),
            description="Joint angle over time, command in grey, response in the joint's colour. "
            + "; ".join(_panel_title(t.joint) for t in traces)
            + ".",
        )
    return Drawing(
        svg, "The last analysed cycles: command in grey, response in the joint's colour."
    )


def _panel_title(joint: JointResult) -> str:
    name = short(joint.name)
    if joint.gain.value is None:
        return name
    lag = estimate(degrees(joint.lag_rad), "°")
    return f"{name}: gain {estimate(joint.gain)}, lag {lag}"


MOST_SPANS = 4
"""Stretches that a row lists; more are counted."""

WHAT = {
    "sensor": "the sensor, not mechanics",
    "sensor or joint": "the sensor or the joint itself",
    "limit": "a limit of the robot",
    "record": "the record, not mechanics",
}
"""What an artefact is about, in words."""


@dataclass(frozen=True)
class ArtefactRow:
    """One artefact, of one or several joints at once, as the page shows it.

    Attributes:
        joints: Joint names, or how many there are.
        meaning: What the values do, and what else is known.
        line: A drawing of that along the session.
    """

    joints: str
    where: str
    flag: str
    meaning: str
    about: str
    times: str
    line: Markup


def artefact_rows(analysis: Analysis) -> tuple[ArtefactRow, ...]:
    """The artefacts of a session, those that several joints have at the same time as one.

    Returns:
        Rows: sensors first, then limits, then the record; each in chain order.
    """
    order = {joint.name: place for place, joint in enumerate(analysis.joints)}
    alike: dict[tuple[object, ...], list[Artefact]] = {}
    for one in analysis.artefacts:
        spans = tuple((round(start, 1), round(stop, 1)) for start, stop in one.spans_s)
        alike.setdefault((one.flag, one.quantity, one.topic, one.note, spans), []).append(one)
    groups = [sorted(same, key=lambda one: order.get(one.joint, 0)) for same in alike.values()]
    first = list(WHAT)
    groups.sort(key=lambda same: (first.index(same[0].about), order.get(same[0].joint, 0)))
    return tuple(_row(same, analysis) for same in groups)


def flagged_joints(joints: Sequence[JointResult]) -> tuple[tuple[str, str], ...]:
    """Flags of the analysed cycles.

    Returns:
        Flag, and the joints that have it.
    """
    found: dict[str, list[str]] = {}
    for joint in joints:
        for flag in joint.flags:
            found.setdefault(flag, []).append(plain(joint.name))
    return tuple((flag, _named(names, len(joints))) for flag, names in found.items())


def _named(names: Sequence[str], count: int) -> str:
    return f"all {count} joints" if len(names) == count > 1 else ", ".join(names)


def times_text(spans: tuple[Span, ...]) -> str:
    """Stretches in words.

    Args:
        spans: From the session's start [s]; none where it is not a matter of time.

    Returns:
        For example ``2.00 to 3.50 s, 7.10 s and 3 more, 4.20 s in all``.
    """
    if not spans:
        return "throughout"
    parts = [
        f"{formats.number(a, 2)} s"
        if f"{a:.2f}" == f"{b:.2f}"
        else f"{formats.number(a, 2)} to {formats.number(b, 2)} s"
        for a, b in spans[:MOST_SPANS]
    ]
    text = ", ".join(parts)
    if len(spans) > MOST_SPANS:
        total = formats.number(sum(b - a for a, b in spans), 2)
        text += f" and {len(spans) - MOST_SPANS} more, {total} s in all"
    return text


def _row(same: Sequence[Artefact], analysis: Analysis) -> ArtefactRow:
    one = same[0]
    about, text = KINDS[one.flag]
    names = [plain(each.joint) for each in same]
    return ArtefactRow(
        joints=_named(names, len(analysis.joints)),
        where=f"{one.quantity} on {one.topic}" if one.topic else one.quantity,
        flag=one.flag,
        meaning=f"values {text}" + (f"; {one.note}" if one.note else ""),
        about=WHAT[about],
        times=times_text(one.spans_s),
        line=_line(one, analysis),
    )


def _line(one: Artefact, analysis: Analysis) -> Markup:
    """The session as a line, the analysed stretch raised, the artefact's stretches dark."""
    whole = analysis.session.duration_s or 1.0
    spans = one.spans_s or ((0.0, whole),)
    analysed = [(w.start_s, w.stop_s) for w in analysis.gait.windows]

    def bars(stretches: tuple[Span, ...], kind: str, least: float) -> Markup:
        path = ""
        for start, stop in stretches:
            left, width = 100 * start / whole, max(100 * (stop - start) / whole, least)
            path += f"M{left:.2f} 0h{width:.2f}v10h-{width:.2f}z"
        return element("path", d=path, class_=kind)

    return element(
        "svg",
        bars(tuple(analysed), "analysed", 0.0),
        bars(spans, "held", 0.8),
        viewBox="0 0 100 10",
        preserveAspectRatio="none",
        class_="spans",
        aria_hidden="true",
    )
