"""What the page shows of a comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from undulog.capture.common.palette import joint_hex

from ...compare.decisions import SIGNIFICANT_DIFFERENCE, WORDS, in_people_units, signed
from ...results.analysis import SessionFacts
from ...results.comparison import BODY, Comparison
from ...results.estimate import Estimate
from ...results.formats import scaled
from ..text_experiment import comparison_method, margin_text
from .motion import waveforms_drawing
from .svg import (
    INK,
    REFERENCE,
    WIDTH_IN,
    Axes,
    Drawing,
    drawing,
    inline_svg,
    joint_ticks,
    key,
    legend,
    new_figure,
)
from .tables import Fact, joint_mark
from .trials import Trial

_DASHED = (0, (5, 3))


@dataclass(frozen=True)
class Panel:
    """One quantity.

    Attributes:
        values: Of the joints, in that unit; those without a value are left out.
    """

    label: str
    values: Sequence[Estimate]
    margin: float


def differences_drawing(
    names: Sequence[str], panels: Sequence[Panel], *, title: str, prefix: str
) -> Drawing:
    """Differences of every joint, head to tail, one panel a quantity.

    Args:
        title: What is subtracted from what.
        prefix: For identifiers, unique in the page.
    """
    colors = joint_hex(len(names))
    with drawing():
        figure = new_figure(WIDTH_IN, 0.8 + 1.6 * len(panels))
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
        for row, panel in enumerate(panels):
            _panel(grid[row, 0], panel, colors)
        last: Axes = grid[-1, 0]
        joint_ticks(last, names)
        last.set_xlabel("joint, head on the left")
        figure.align_ylabels()
        middle = colors[len(colors) // 2]
        legend(
            figure,
            [
                key([], [], color=middle, marker="o", label="difference, 95 %"),
                key([], [], color=REFERENCE, linestyle=_DASHED, label="margins"),
            ],
        )
        told = ", ".join(panel.label for panel in panels)
        svg = inline_svg(
            figure,
            prefix=prefix,
            title=title,
            description=f"{len(names)} joints; panels: {told}.",
        )
    return Drawing(svg, f"{title}. The intervals hold together at 95 %; dashed: the margins.")


def _panel(axes: Axes, panel: Panel, colors: Sequence[str]) -> None:
    axes.axhline(0.0, color=REFERENCE, linewidth=0.8, zorder=1)
    for margin in (-panel.margin, panel.margin):
        axes.axhline(margin, color=REFERENCE, linestyle=_DASHED, linewidth=0.8, zorder=1)
    for place, (value, color) in enumerate(zip(panel.values, colors, strict=True), start=1):
        if value.value is None:
            continue
        if value.ci95 is not None:
            axes.plot([place, place], value.ci95, color=color, linewidth=1.6, zorder=2)
        axes.plot(
            [place],
            [value.value],
            "o",
            markersize=5.2,
            markerfacecolor=color,
            markeredgecolor=INK,
            markeredgewidth=0.5,
            zorder=3,
        )
    axes.set_ylabel(panel.label)
    axes.margins(y=0.15)


_VERDICTS = {
    "different": "different",
    "small": "different, but within the margins",
    "same": "the same within the margins",
    "open": "open",
}


@dataclass(frozen=True)
class ComparisonView:
    """All that the template shows of a comparison.

    Attributes:
        sides: Letter and session, A first.
        marks: Of the joints that answer differently.
        differences: Of every joint, as a picture; None where there are none.
        waveforms: Mean cycles, or None.
        trials: What is shown to be the same.
    """

    comparison: Comparison
    sentence: str
    sides: tuple[tuple[str, SessionFacts], ...]
    facts: tuple[Fact, ...]
    marks: tuple[Markup, ...]
    differences: Drawing | None
    waveforms: Drawing | None
    trials: tuple[Trial, ...]
    method: str


def comparison_view(comparison: Comparison) -> ComparisonView:
    """Prepare what the template shows of a comparison."""
    sides = (("A", comparison.a), ("B", comparison.b))
    return ComparisonView(
        comparison=comparison,
        sentence=comparison.answer,
        sides=tuple((letter, one) for letter, sessions in sides for one in sessions),
        facts=tuple(_facts(comparison)),
        marks=_marks(comparison),
        differences=differences_of(comparison, "differences") if joints_of(comparison) else None,
        waveforms=waveforms_drawing(comparison, "waveforms") if comparison.waveforms else None,
        trials=_trials(comparison),
        method=comparison_method(comparison),
    )


def joints_of(comparison: Comparison) -> list[str]:
    """The joints that are compared.

    Returns:
        Names, head to tail where mean cycles say so, else by name.
    """
    return [one.name for one in comparison.waveforms] or sorted(
        {one.place for one in comparison.differences if one.quantity == "gain"}
    )


def differences_of(comparison: Comparison, prefix: str) -> Drawing:
    """Draw the differences of every joint.

    Args:
        comparison: With at least one joint.
        prefix: For identifiers, unique in the page.

    Returns:
        Gain, lag and energy, one panel each.
    """
    names = joints_of(comparison)
    known = {(one.quantity, one.place): one.difference for one in comparison.differences}
    margins = {one.quantity: one.margin for one in comparison.equivalence}
    panels: list[Panel] = []
    for quantity, label, factor in (
        ("gain", "gain [%]", 100.0),
        ("lag", "lag [°]", math.degrees(1)),
        ("energy_abs", "E_abs [mJ a cycle]", 1000.0),
    ):
        if quantity in margins:
            values = [scaled(known.get((quantity, name), Estimate()), factor) for name in names]
            panels.append(Panel(label, values, factor * margins[quantity]))
    return differences_drawing(names, panels, title="B minus A of every joint", prefix=prefix)


def _marks(comparison: Comparison) -> tuple[Markup, ...]:
    names = joints_of(comparison)
    colors = dict(zip(names, joint_hex(len(names)), strict=True)) if names else {}
    return tuple(joint_mark(colors[one.name], "horizontal") for one in comparison.named)


def _trials(comparison: Comparison) -> tuple[Trial, ...]:
    return tuple(
        Trial(
            f"Is the {WORDS[one.quantity]} the same on both sides, within {margin_text(one)}?",
            f"largest difference {margin_text(one, one.largest)}",
            one.p,
            "yes, shown to be the same" if one.p < SIGNIFICANT_DIFFERENCE else "not shown",
        )
        for one in comparison.equivalence
    )


def _facts(comparison: Comparison) -> list[Fact]:
    a, b = len(comparison.a), len(comparison.b)
    joints = len(joints_of(comparison))
    facts = [
        Fact("Verdict", _VERDICTS[comparison.verdict], "all quantities together, Holm at 5 %"),
        Fact("Sessions", f"{a} and {b}", "on side A and B"),
        Fact("Joints that differ", f"{len(comparison.named)} of {joints}", "in gain or lag"),
    ]
    for quantity in ("gain", "lag"):
        of = [one for one in comparison.differences if one.quantity == quantity]
        if of:
            worst = max(of, key=lambda one: one.size)
            told = signed(*in_people_units(worst))
            facts.append(Fact(f"Largest in {quantity}", told, f"B minus A, {worst.place}"))
    for one in comparison.differences:
        if one.place == BODY:
            told = signed(*in_people_units(one))
            facts.append(Fact(WORDS[one.quantity].capitalize(), told, "B minus A"))
    return facts
