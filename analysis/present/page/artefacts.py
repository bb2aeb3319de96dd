"""What is wrong with samples, and when: rows with their place in the session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from undulog.capture.common.console import plain

from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.artefact import KINDS, Artefact, Span
from .typeset import element

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
        where: Quantity and topic.
        flag: Its name.
        meaning: What the values do, and what else is known.
        about: Whose fault it is.
        times: When it holds.
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

    Args:
        analysis: Its numbers.

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

    Args:
        joints: In chain order.

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


def told_times(spans: tuple[Span, ...]) -> str:
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
        times=told_times(one.spans_s),
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
