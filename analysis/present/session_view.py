"""Prepare one session for the page: its answer, figures, artefacts, and a few joints' signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.console import plain
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.common.palette import joint_hex
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC

from ..common import formats
from ..common.answer import Verdict
from ..common.formats import degrees, estimate, short
from ..parts.artefacts.result import KINDS, Artefact, Span
from ..parts.joints.result import JointResult
from ..parts.oscillators.result import ChainCoupling
from ..parts.oscillators.show import chain_detail
from ..results.analysis import Analysis
from ..session.cycle_maps import CycleMaps
from .bode import bode, cycle_drawings
from .matrix import Entries, entries_of, matrix_picture
from .page_tables import element, is_driven, joint_mark, key_figures, session_trials
from .part_figures import draw
from .segments import body_motion, segments
from .svg import COMMAND, Drawing, drawing, inline_svg, key, legend
from .text import shown_parts

CYCLES = 2.5
"""Gait cycles shown."""

SECONDS_WITHOUT_GAIT = 5.0
"""Shown where there is no gait [s]."""

MOST_POINTS = 600
"""Samples drawn a line; more would only add bytes, a figure is about 900 pixels wide."""

MOST_SPANS = 4
"""Stretches that a row lists; more are counted."""

WHAT = {
    "sensor": "the sensor, not mechanics",
    "sensor or joint": "the sensor or the joint itself",
    "sensor or limit": "the sensor or a limit of the servo",
    "limit": "a limit of the robot",
    "record": "the record, not mechanics",
}
"""Text for each source of artefacts."""


@dataclass(frozen=True)
class Trace:
    """Command and response of one joint over a time window.

    Attributes:
        place: Index of the joint in the chain, from 0 at the head.
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
    """Return head, middle and tail end of the plane with most driven joints.

    Returns:
        Up to three indices, ascending; of all joints if none is driven.
    """
    planes = [joint.plane for joint in joints if is_driven(joint)]
    most = max(dict.fromkeys(planes), key=planes.count, default=None)
    members = [i for i, j in enumerate(joints) if is_driven(j) and j.plane == most]
    members = members or list(range(len(joints)))
    return sorted({members[k] for k in (0, len(members) // 2, -1)}) if members else []


def stretch_s(analysis: Analysis) -> tuple[float, float]:
    """Return start and stop of the last cycles of the last analysed window [s]."""
    frequency = analysis.gait.frequency_hz.value
    length = CYCLES / frequency if frequency else SECONDS_WITHOUT_GAIT
    spans = [(window.start_s, window.stop_s) for window in analysis.gait.windows]
    first, stop = spans[-1] if spans else (0.0, analysis.session.duration_s)
    return max(first, stop - length), stop


def read_traces(session: SessionView, analysis: Analysis) -> tuple[Trace, ...]:
    """Return the samples of a few joints from the analysed topics.

    Returns:
        One trace a chosen joint; empty if a topic or all samples are missing.
    """
    options = analysis.provenance.options
    start_ns = analysis.session.start_ns
    start, stop = (start_ns + round(time_s * 1e9) for time_s in stretch_s(analysis))
    try:
        command, response = (
            session.joints(str(topic), "position", start_ns=start, stop_ns=stop)
            for topic in (
                options.get("command_topic") or COMMAND_TOPIC,
                options.get("response_topic") or RESPONSE_TOPIC,
            )
        )
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
                columns += [np.empty(0)] * 2
        if columns[3].size:
            traces.append(Trace(joint, place, *columns))
    return tuple(traces)


def _thinned(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return every k-th finite sample, k the least that keeps within ``MOST_POINTS``."""
    finite = np.isfinite(values)
    t_s, values = t_s[finite], values[finite]
    step = max(1, -(-len(t_s) // MOST_POINTS))
    return frozen(t_s[::step]), frozen(values[::step])


def command_response(traces: Sequence[Trace], joint_count: int, prefix: str) -> Drawing:
    """Draw command (grey) and response (coloured) of a few joints, one panel each.

    Args:
        joint_count: Joints in the chain, for their colours.
        prefix: For identifiers, unique in the page.
    """
    colors = joint_hex(joint_count)
    tooltips: dict[str, str] = {}
    with drawing(0.7 + 1.35 * len(traces)) as figure:
        grid = figure.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)
        for (axes,), trace in zip(grid, traces, strict=True):
            command, response = np.degrees(trace.command_rad), np.degrees(trace.response_rad)
            at, color = trace.place, colors[trace.place]
            axes.plot(trace.command_t_s, command, gid=f"command-{at}", **COMMAND)
            axes.plot(
                trace.response_t_s, response, gid=f"response-{at}", color=color, linewidth=1.6
            )
            for what in ("command", "response"):
                tooltips[f"{what}-{at}"] = f"{trace.joint.name} {what}"
            axes.set_title(_panel_title(trace.joint))
            axes.margins(x=0.01)
        figure.supylabel("joint angle [°]", fontsize=8.0)
        grid[-1, 0].set_xlabel("time from the session's start [s]")
        command_key = key(label="command", **COMMAND)
        middle = colors[traces[len(traces) // 2].place]
        legend(figure, command_key, key(color=middle, label="response"))
        title = "Command and response of " + ", ".join(t.joint.name for t in traces)
        about = "Joint angle over time, command dashed, response in the joint's colour. "
        about += "; ".join(_panel_title(t.joint) for t in traces) + "."
        svg = inline_svg(figure, prefix, title, about, tooltips)
    return Drawing(svg, "The last analysed cycles: command dashed, response in the joint's colour.")


def _panel_title(joint: JointResult) -> str:
    values = f": gain {estimate(joint.gain)}, lag {estimate(degrees(joint.lag_rad), '°')}"
    return short(joint.name) + ("" if joint.gain.value is None else values)


@dataclass(frozen=True)
class ArtefactRow:
    """A row of the page's table: one artefact of one or several joints.

    Attributes:
        joints: Joint names, or their number.
        meaning: Behaviour of the values, and the artefact's note.
        line: Drawing of the time windows along the session.
    """

    joints: str
    where: str
    flag: str
    meaning: str
    about: str
    times: str
    line: Markup


def artefact_rows(analysis: Analysis) -> tuple[ArtefactRow, ...]:
    """Return the artefacts of a session; those of several joints at the same time are one row.

    Returns:
        Rows: sensors first, then limits, then the record; each in chain order.
    """
    order = {joint.name: place for place, joint in enumerate(analysis.joints)}
    alike: dict[tuple[object, ...], list[Artefact]] = {}
    for artefact in analysis.artefacts:
        spans = tuple((round(start, 1), round(stop, 1)) for start, stop in artefact.spans_s)
        alike.setdefault(
            (artefact.flag, artefact.quantity, artefact.topic, artefact.note, spans), []
        ).append(artefact)
    groups = [
        sorted(same, key=lambda artefact: order.get(artefact.joint, 0)) for same in alike.values()
    ]
    first = list(WHAT)
    groups.sort(key=lambda same: (first.index(same[0].about), order.get(same[0].joint, 0)))
    return tuple(_row(same, analysis) for same in groups)


def flagged_joints(joints: Sequence[JointResult]) -> tuple[tuple[str, str], ...]:
    """Return each flag of the analysed cycles with the names of its joints."""
    flagged: dict[str, list[str]] = {}
    for joint in joints:
        for flag in joint.flags:
            flagged.setdefault(flag, []).append(plain(joint.name))
    return tuple((flag, _named(names, len(joints))) for flag, names in flagged.items())


def _named(names: Sequence[str], count: int) -> str:
    return f"all {count} joints" if len(names) == count > 1 else ", ".join(names)


def times_text(spans: tuple[Span, ...]) -> str:
    """Return time windows as text, e.g. ``2.00 to 3.50 s, 7.10 s and 3 more, 4.20 s in all``.

    Args:
        spans: From the session's start [s]; none if the artefact lasts throughout.
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
    first = same[0]
    about, text = KINDS[first.flag]
    return ArtefactRow(
        joints=_named([plain(artefact.joint) for artefact in same], len(analysis.joints)),
        where=f"{first.quantity} on {first.topic}" if first.topic else first.quantity,
        flag=first.flag,
        meaning=f"values {text}" + (f"; {first.note}" if first.note else ""),
        about=WHAT[about],
        times=times_text(first.spans_s),
        line=_line(first, analysis),
    )


def _line(artefact: Artefact, analysis: Analysis) -> Markup:
    """Return the session as a line: analysed window light, the artefact's windows dark."""
    whole = analysis.session.duration_s or 1.0
    analysed = tuple((w.start_s, w.stop_s) for w in analysis.gait.windows)

    def bars(stretches: tuple[Span, ...], kind: str, least: float) -> Markup:
        path = ""
        for start, stop in stretches:
            left, width = 100 * start / whole, max(100 * (stop - start) / whole, least)
            path += f"M{left:.2f} 0h{width:.2f}v10h-{width:.2f}z"
        return element("path", d=path, class_=kind)

    return element(
        "svg",
        bars(analysed, "analysed", 0.0),
        bars(artefact.spans_s or ((0.0, whole),), "held", 0.8),
        viewBox="0 0 100 10",
        preserveAspectRatio="none",
        class_="spans",
        aria_hidden="true",
    )


def session_view(
    analysis: Analysis, session: SessionView | None, cycles: CycleMaps | None, at: str = ""
) -> dict[str, Any]:
    """Return what the template shows of one session, by name.

    Args:
        session: To draw its samples, or None.
        cycles: To draw their maps, or None.
        at: For identifiers, where the page has several sessions.
    """
    joints = analysis.joints
    colors = joint_hex(len(joints)) if joints else ()
    traces = read_traces(session, analysis) if session is not None else ()
    body = analysis.body
    answer = analysis.answer
    entries = entries_of(analysis.coupling, tuple(j.name for j in joints if is_driven(j)))
    drawn = [(j.gain.value, j.energy_net_j, j.energy_abs_j) for j in joints]
    numbers = any(value is not None for values in drawn for value in values)
    numbers = numbers or bool(analysis.tracking)
    return {
        "analysis": analysis,
        "answer": answer,
        "question": _question(analysis),
        "warnings": [w for w in analysis.warnings if formats.sentence(w) not in answer.detail],
        "facts": key_figures(analysis),
        "marks": [
            joint_mark(color, joint.plane, driven=is_driven(joint))
            for color, joint in zip(colors, joints, strict=True)
        ],
        "trials": session_trials(analysis.heterogeneity),
        "segments": segments(joints, f"{at}segments-figure", analysis.tracking)
        if numbers
        else None,
        "bode": bode(analysis.frequency_response, f"{at}bode-figure"),
        "signals": command_response(traces, len(joints), f"{at}signals-figure") if traces else None,
        "maps": () if cycles is None else cycle_drawings(cycles, f"{at}map"),
        "artefacts": artefact_rows(analysis),
        "parts": [
            {
                "name": name,
                "title": part.title,
                "tables": part.tables,
                "drawings": [
                    draw(figure, part.title, f"{at}{name}-{k}-figure")
                    for k, figure in enumerate(part.figures, start=1)
                ],
            }
            for name, part in shown_parts(analysis).items()
        ],
        "flagged": flagged_joints(joints),
        "body": body_motion(body, f"{at}body-figure")
        if body is not None and body.observed
        else None,
        "entries": entries,
        "matrix": matrix_picture(entries[0], f"{at}coupling-figure") if entries else None,
        "chains": [
            chain_view(chain, f"{at}oscillators-{k}-figure")
            for k, chain in enumerate(analysis.oscillators, start=1)
        ],
    }


def _question(analysis: Analysis) -> str:
    """Return the question that the answer of a session answers."""
    if analysis.free_motion is not None and analysis.free_motion.joints:
        return "How does the body move without commands?"
    if analysis.answer.verdict is Verdict.SINGLE:
        return "How does the joint respond to its command?"
    return "Do all joints respond to their commands alike, and if not, which differ, and how?"


def chain_view(chain: ChainCoupling, prefix: str) -> dict[str, Any]:
    """Return what the template shows of one chain of oscillators, by name.

    Args:
        prefix: For identifiers, unique in the page.
    """
    lines = list(chain_detail(chain))
    lags = [formats.degrees(link.lag_rad) for link in chain.links]
    rates = chain.oscillators
    return {
        "chain": chain,
        "sentence": lines[0].partition(": ")[2] if chain.identifiable else None,
        "method": lines[-1].removeprefix("Method: ") if chain.identifiable else "",
        "matrix": matrix_picture(_couplings(chain), prefix) if chain.links else None,
        "decimals": (  # of K, of the rates and of the feedback
            formats.decimals_for((link.K for link in chain.links), most=3),
            formats.decimals_for((rate.omega for rate in rates), most=4),
            formats.decimals_for((rate.feedback for rate in rates), most=3),
        ),
        "lags": lags,
        "lag_decimals": formats.decimals_for(lags, most=2),
        "fed": any(rate.feedback.value is not None for rate in rates),
    }


def _couplings(chain: ChainCoupling) -> Entries:
    """Return K as a matrix with NaN for couplings that were not estimated."""
    names = tuple(oscillator.name for oscillator in chain.oscillators)
    place = {name: k for k, name in enumerate(names)}
    value: FloatArray = np.full((len(names), len(names)), np.nan)
    half: FloatArray = np.zeros_like(value)
    for link in chain.links:
        at = place[link.target], place[link.source]
        value[at] = link.K.value or 0.0
        if link.K.ci95 is not None:
            half[at] = (link.K.ci95[1] - link.K.ci95[0]) / 2
    meaning = f"coupling of oscillators, {chain.plane} [1/s]; looked for up to {chain.reach} apart"
    words = ("the oscillator that is turned", "the oscillator that turns it", "is turned by")
    return Entries("K", meaning, names, names, value, half, *words)
