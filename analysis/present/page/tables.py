"""Write key figures, tables, numbers and parts of drawings as HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

from undulog.capture.common.console import plain

from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.estimate import Estimate
from ..tables import PAGE, Cell, Ends, PValue, Quantity, Table

STILL_RAD = 1e-6
"""A command with less amplitude than this holds its joint still [rad]."""


def is_driven(joint: JointResult) -> bool:
    """Return whether a joint has a command that moves, even if its response is missing."""
    amplitude = joint.command_amplitude_rad
    return joint.gain.value is not None or (amplitude is not None and amplitude > STILL_RAD)


def element(name: str, *children: object, **attributes: object) -> Markup:
    """Return an element.

    Args:
        children: Elements, or text, which is escaped.
        attributes: By name; ``class_`` is ``class``, other underscores are hyphens; None is left
            out, numbers keep two decimals.
    """
    pairs = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(_value(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{pairs}>{joined(children)}</{name}>")  # noqa: S704  escaped here


def joined(children: Iterable[object]) -> Markup:
    """Return elements and text, which is escaped, one behind the other."""
    return Markup("").join(
        child if isinstance(child, Markup) else escape(plain(str(child))) for child in children
    )


def svg_element(
    prefix: str, title: str, description: str, *children: Markup, **attributes: object
) -> Markup:
    """Return an ``<svg>`` element with an accessible name and description.

    Args:
        prefix: Of identifiers, unique in the page.
    """
    return element(
        "svg",
        element("title", title, id=f"{prefix}-title"),
        element("desc", description, id=f"{prefix}-desc"),
        *children,
        **attributes,
        aria_labelledby=f"{prefix}-title",
        aria_describedby=f"{prefix}-desc",
    )


LEVELS = 48
"""Steps of a colour scale."""


def hue(level: int, *, signed: bool) -> dict[str, str]:
    """Return class and style of a colour.

    Args:
        level: From 0 to ``LEVELS``.
        signed: Whether the scale has one hue below its middle and another above.
    """
    if not signed:
        return {"class_": "q", "style": f"--v:{100 * level / LEVELS:.0f}%"}
    kind = "plus" if 2 * level >= LEVELS else "minus"
    return {"class_": kind, "style": f"--v:{abs(2 * level - LEVELS) / LEVELS:.0%}"}


def color_bar(
    left: float, top: float, width: float, height: float, *, signed: bool
) -> list[Markup]:
    """Return the rectangles of a colour scale."""
    sizes = {"y": top, "width": width / (LEVELS + 1) + 0.4, "height": height}
    return [
        element("rect", x=left + width * n / (LEVELS + 1), **sizes, **hue(n, signed=signed))
        for n in range(LEVELS + 1)
    ]


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.2f}".rstrip("0").rstrip(".")
    return plain(str(value))


NO_BREAK = "\N{NO-BREAK SPACE}"

_UNIT = re.compile(r"(?<=\d) (?=(?:%|Hz|J|s|rad|mm|N m|kB)(?![\w]))")
_INTERVAL = re.compile(r"\[[^]]*\]")
_P = re.compile(r"\bp ([<=]) ")
_INVERSE = "\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ONE}"


def typeset(text: str) -> str:
    """Return text without line breaks between numbers and units, and with ``H^-1`` raised."""
    known = _UNIT.sub(NO_BREAK, plain(text).replace("^-1", _INVERSE))
    return _P.sub(rf"p{NO_BREAK}\1{NO_BREAK}", known)


def sentence(text: str) -> str:
    """Return text as a typeset sentence with capital and full stop."""
    return typeset(formats.sentence(text))


def softer(text: str) -> Markup:
    """Set the intervals of a sentence in smaller type."""
    marked = _INTERVAL.sub(r'<span class="ci">\g<0></span>', str(escape(typeset(text))))
    return Markup(marked)  # noqa: S704  escaped above


def digits(value: float) -> str:
    """Return a number of any size with two digits, e.g. ``0.026`` or ``3.4e−9``."""
    return f"{value:.2g}".replace("-", formats.MINUS)


_NOT_COMPUTED = Markup(
    '<span class="null"><span aria-hidden="true">{}</span>'
    '<span class="hidden">not computed</span></span>'
).format(formats.MISSING)


@dataclass(frozen=True)
class Fact:
    """A key figure, with a note in small print, which may be empty."""

    name: str
    value: str
    note: str = ""


_CLASSES = {"number": ' class="n"', "sentence": ' class="say"', "word": "", "code": ""}


def grid(table: Table[Any], marks: Sequence[Markup] = ()) -> Markup:
    """Return the elements ``thead`` and ``tbody`` of a table.

    Args:
        marks: Elements before the name of each row, if any.
    """
    columns = [column for column in table.columns if column.page is not None]
    count = '<th scope="col" class="n i">#</th>' if table.numbered else ""
    lines = [f"<thead><tr>{count}"]
    for column in columns:
        kind = _CLASSES[column.kind] if column.kind == "number" else ""
        lines[0] += f'<th scope="col"{kind}>{escape(column.page)}</th>'
    lines[0] += "</tr></thead>"
    lines.append("<tbody>")
    cells = zip(*(column.cells(table.rows, PAGE) for column in columns), strict=True)
    for k, (row, values) in enumerate(zip(table.rows, cells, strict=True)):
        line = '<tr class="sure">' if table.bold(row) else "<tr>"
        line += f'<td class="n i">{k + 1}</td>' if table.numbered else ""
        for column, value in zip(columns, values, strict=True):
            head = column is columns[0]
            shown = _shown(value)
            if column.kind == "code":
                shown = Markup("<code>{}</code>").format(shown)
            if head and marks:
                shown = marks[k] + shown
            element = 'th scope="row"' if head else "td"
            line += f"<{element}{_CLASSES[column.kind]}>{shown}</{element[:2]}>"
        lines.append(f"{line}</tr>")
    return Markup("\n".join([*lines, "</tbody>"]))  # noqa: S704  each cell is escaped


def joint_mark(color: str, plane: str | None, *, driven: bool = True) -> Markup:
    """Return the mark of a joint, for the left of its name."""
    kind = plane if plane in ("horizontal", "vertical") else "unknown"
    return Markup('<span class="mark {}{}" style="--c: {}"></span>').format(
        kind, "" if driven else " passive", color
    )


def _shown(cell: Cell) -> Markup:
    match cell:
        case Quantity(quantity, decimals, unit):
            return estimate(quantity, decimals, unit)
        case Ends(low, high):
            return Markup("{} to {}").format(_shown(low), _shown(high))
        case PValue():
            return p_value(cell)
        case _:
            return known(cell)


def number(value: float | None, decimals: int) -> Markup:
    """Return a number that keeps its full precision in the page, or a dash."""
    if value is None:
        return _NOT_COMPUTED
    return Markup('<data value="{}">{}</data>').format(value, formats.number(value, decimals))


def estimate(quantity: Estimate, decimals: int, unit: str = "") -> Markup:
    """Return a number, or a dash, with its interval in smaller type."""
    shown = number(quantity.value, decimals) + ("" if quantity.value is None else unit)
    if quantity.ci95 is None:
        return shown
    low, high = (number(end, decimals) for end in quantity.ci95)
    return Markup('{} <span class="ci">[{}, {}]</span>').format(shown, low, high)


def p_value(p: float | None) -> Markup:
    """Return a p-value that keeps its full precision in the page, or a dash."""
    if p is None:
        return _NOT_COMPUTED
    return Markup('<data value="{}">{}</data>').format(p, formats.p_value(p).replace(" ", NO_BREAK))


def known(value: object) -> Markup:
    """Return a value as escaped text, or a dash for None."""
    return _NOT_COMPUTED if value is None else escape(plain(str(value)))


def key_figures(analysis: Analysis) -> list[Fact]:
    """Return the eight figures at the top of the page; seven without joints."""
    gait, joints = analysis.gait, analysis.joints
    driven = [joint for joint in joints if is_driven(joint)]
    count = f"{len(driven)} of {len(joints)}" if driven else formats.MISSING
    gains = [(j.gain.value, j.name) for j in joints if j.gain.value is not None]
    lags = [(math.degrees(v), j.name) for j in joints if (v := j.lag_rad.value) is not None]
    energies = [j.energy_abs_j for j in joints if j.energy_abs_j is not None]
    total, energy_note = formats.MISSING, ""
    if energies:
        sum_j = math.fsum(energies)
        total = f"{formats.number(sum_j, formats.decimals_for_values([sum_j]))} J"
        energy_note = f"{len(energies)} of {len(joints)} joints"
    steps = [
        f"{formats.number(math.degrees(lag), 1)}° a joint, {plain(plane)}"
        for plane, lag in gait.lag_per_joint_rad.items()
    ]
    facts = [
        Fact("Gait frequency", formats.gait_frequency(gait), _analysed(analysis)),
        Fact("Wave", (gait.wave or formats.MISSING).replace("-", " "), ", ".join(steps)),
        Fact("Joints in the gait", count),
        _range("Gain", gains, formats.decimals_for((j.gain for j in joints), most=3), ""),
        _range("Lag", lags, 1, "°"),
        Fact("Mechanical energy E_abs", total, energy_note),
    ]
    if joints:
        least = min(joints, key=lambda j: j.coverage)
        where = plain(least.name) if least.coverage < 0.9995 else "every joint"
        facts.append(Fact("Lowest coverage", formats.coverage(least.coverage), where))
    points = analysis.body.observed if analysis.body is not None else ()
    sizes = [formats.number(formats.scaled(p.amplitude_m, 1000.0).value, 0) for p in points]
    amplitude = " / ".join(sizes) + " mm" if sizes else formats.MISSING
    return [*facts, Fact("Body amplitude", amplitude, plain(" / ".join(p.place for p in points)))]


def _range(name: str, values: Sequence[tuple[float, str]], decimals: int, unit: str) -> Fact:
    if not values:
        return Fact(name, formats.MISSING)
    (low, first), (high, last) = min(values), max(values)
    if len(values) == 1:
        return Fact(name, formats.number(low, decimals) + unit, plain(first))
    text = f"{formats.number(low, decimals)}{unit} to {formats.number(high, decimals)}{unit}"
    return Fact(name, text, plain(f"{first}, {last}"))


def _analysed(analysis: Analysis) -> str:
    windows = analysis.gait.windows
    if not windows:
        return "nothing analysed"
    cycles = math.fsum(window.cycles for window in windows)
    spans = ", ".join(f"{w.start_s:.2f} to {w.stop_s:.2f} s" for w in windows[:3])
    more = f" and {len(windows) - 3} more" if len(windows) > 3 else ""
    return f"{cycles:.0f} cycles, {spans}{more}" if cycles else f"{spans}{more}"
