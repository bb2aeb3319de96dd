"""Write key figures, tables, tests as questions with answers, and parts of drawings as HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

from undulog.capture.common.console import plain

from ..common import formats
from ..common.estimate import Estimate
from ..experiment.reversal import SIGNIFICANT
from ..parts.comparison.answer import find
from ..parts.gait.show import gait_frequency
from ..parts.heterogeneity.result import Index
from ..parts.joints.result import JointResult
from ..parts.shown import PAGE, Cell, Ends, PValue, ShownNumber, Table
from ..results.analysis import Analysis
from ..results.coupling import LocalCoupling, RowCheck
from ..results.experiment import Experiment, Reversal

STILL_RAD = 1e-6
"""A command with less amplitude than this holds its joint still [rad]."""

LEVELS = 48
"""Steps of a colour scale."""

NO_BREAK = "\N{NO-BREAK SPACE}"

_UNIT = re.compile(r"(?<=\d) (?=(?:%|Hz|J|s|rad|mm|N m|kB)(?![\w]))")
_INTERVAL = re.compile(r"\[[^]]*\]")
_P = re.compile(r"\bp ([<=]) ")
_INVERSE = "\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ONE}"

_NOT_COMPUTED = Markup(
    '<span class="null"><span aria-hidden="true">{}</span>'
    '<span class="hidden">not computed</span></span>'
).format(formats.MISSING)

_CLASSES = {"number": ' class="n"', "sentence": ' class="say"', "word": "", "code": ""}

LEVEL_NOTE = (
    f"Each test stands by itself at a level of {100 * SIGNIFICANT:g} %; those that look at several "
    "joints at once are family-wise over them. A question that could not be answered is open, not "
    "answered with no."
)

_MARGINS = {"gain": "2 %", "lag": "1°"}


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


def typeset(text: str) -> str:
    """Return text without line breaks between numbers and units, and with ``H^-1`` raised."""
    spaced = _UNIT.sub(NO_BREAK, plain(text).replace("^-1", _INVERSE))
    return _P.sub(rf"p{NO_BREAK}\1{NO_BREAK}", spaced)


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


@dataclass(frozen=True)
class Fact:
    """A key figure, with a note in small print, which may be empty."""

    name: str
    value: str
    note: str = ""


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
        case ShownNumber(quantity, decimals, unit):
            return estimate(quantity, decimals, unit)
        case Ends(low, high):
            return Markup("{} to {}").format(_shown(low), _shown(high))
        case PValue():
            return p_value(cell)
        case _:
            return escaped(cell)


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


def escaped(value: object) -> Markup:
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
        Fact("Gait frequency", gait_frequency(gait), _analysed(analysis)),
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


@dataclass(frozen=True)
class Trial:
    """A test as a question.

    Attributes:
        statistic: With unit and interval.
        p: Of the null hypothesis; None if the answer rests on an interval or a bound.
    """

    question: str
    statistic: str
    p: float | None
    verdict: str


def session_trials(indices: Mapping[str, Index]) -> list[Trial]:
    """Return the tests of one session, plane by plane."""
    trials = [
        _common(index, _of(plane)) for plane, index in find(indices, "common_response").items()
    ]
    for quantity in ("gain", "lag"):
        for plane, index in find(indices, f"boundary_contrast_{quantity}").items():
            trials.append(_contrast(index, quantity, _of(plane)))
    for quantity in ("gain", "lag"):
        for plane, index in find(indices, f"equivalence_{quantity}").items():
            question = f"within {_MARGINS[quantity]} of the mean of {_of(plane)}?"
            trials.append(_equivalence(index, quantity, f"Is every {quantity} {question}"))
    return trials


def experiment_trials(experiment: Experiment) -> list[Trial]:
    """Return the tests of several sessions together."""
    trials: list[Trial] = []
    indices = experiment.heterogeneity
    common = indices.get("common_response")
    if common is not None and common.value is not None:
        trials.append(_common(common, "the driven joints"))
    if experiment.reversal is not None:
        trials += _reversal(experiment.reversal, indices)
    if isinstance(experiment.coupling, LocalCoupling):
        trials += _kicks(experiment.coupling)
    return trials


def _kicks(coupling: LocalCoupling) -> Iterable[Trial]:
    sums = "as any settled gait's do" if coupling.checks_pass else "not in all rows: settle longer"
    for symbol, rows in (("P", coupling.phase_rows), ("R", coupling.gain_rows)):
        question = f"Do rows of {symbol} sum to {rows[0].expected:g}, as shifting time demands?"
        yield Trial(question, f"largest deviation {_worst(rows)}", None, sums)
    index = coupling.nonlinearity
    if index.value is not None and index.ci95 is not None:
        linear = index.ci95[0] <= 0.0
        yield Trial(
            "Is the chain linear and time-invariant around this gait?",
            f"nonlinearity {formats.percent(index)}",
            None,
            "a deviation could not be shown" if linear else "no: H is descriptive only",
        )
    if coupling.held_out:
        good = sum(
            2 * prediction.error <= prediction.error_kept for prediction in coupling.held_out
        )
        reach = coupling.valid_to
        yield Trial(
            "Do the matrices predict gaits that were not used?",
            f"{good} of {len(coupling.held_out)} at least twice as well as 'each joint keeps "
            "its response'",
            None,
            "not even the smallest" if reach is None else f"yes, up to {reach:.3f} rad",
        )


def _of(end: str) -> str:
    plane, _, group = end.partition("group")
    words = {"horizontal": "the yaw joints", "vertical": "the pitch joints"}
    word = words.get(plane.rstrip("_"), "the driven joints")
    return f"{word} of group {group}" if group else word


def _common(index: Index, whose: str) -> Trial:
    different = index.p is not None and index.p < SIGNIFICANT
    return Trial(
        f"Do {whose} all have the same gain and lag? (H0)",
        f"F = {formats.number(index.value, 1)}",
        index.p,
        "no, they differ" if different else "open: no difference could be shown",
    )


def _contrast(index: Index, quantity: str, whose: str) -> Trial:
    value = Estimate(index.value, index.ci95)
    if quantity == "lag":
        size = formats.estimate(formats.degrees(value), "°")
    else:
        size = formats.estimate(value, most=5)
    low, high = index.ci95 or (-math.inf, math.inf)
    verdict = "open: no difference could be shown"
    if low > 0 or high < 0:
        verdict = f"yes, {quantity} is larger {'at the ends' if low > 0 else 'in the middle'}"
    question = f"Does {quantity} differ between ends and middle of {whose}?"
    return Trial(question, f"ends minus middle {size}", index.p, verdict)


def _equivalence(index: Index, quantity: str, question: str) -> Trial:
    alike = index.p is not None and index.p < SIGNIFICANT
    scale, unit = (100.0, " %") if quantity == "gain" else (180.0 / math.pi, "°")
    return Trial(
        question,
        f"largest deviation {formats.number(scale * (index.value or 0.0), 2)}{unit}",
        index.p,
        "yes, shown to be alike" if alike else "not shown",
    )


def _reversal(reversal: Reversal, indices: Mapping[str, Index]) -> Iterable[Trial]:
    different = reversal.p < SIGNIFICANT
    no = "no, but not as a module would make it"
    if reversal.pairs:
        no = f"no, modules differ{'' if reversal.tilt.excluded else ' or the floor is tilted'}"
    yield Trial(
        "Do the modules mirror, as identical ones do? (H1, reversal)",
        f"T = {formats.number(reversal.statistic, 2)}",
        reversal.p,
        no if different else "open: no difference could be shown",
    )
    for quantity in ("gain", "lag"):
        index = indices.get(f"equivalence_mirror_{quantity}")
        if index is not None and index.value is not None:
            question = f"Is every joint's {quantity} within {_MARGINS[quantity]} of its mirror's?"
            yield _equivalence(index, quantity, question)


def _worst(rows: tuple[RowCheck, ...]) -> str:
    worst = max(rows, key=lambda row: abs((row.total.value or 0.0) - row.expected))
    off = abs((worst.total.value or 0.0) - worst.expected)
    digits = formats.decimals_for_values([off], 2)
    return f"{formats.number(off, digits)} ({plain(worst.name)})"
