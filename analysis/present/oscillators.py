"""Prepare oscillators that feel their own servos for the page: facts, rates, entrainment."""

from __future__ import annotations

import numpy as np

from ..common import formats
from ..results.oscillators import BodyOscillators
from .matrix import Entries
from .page_tables import Fact
from .svg import DASHED, INK, REFERENCE, Drawing, drawing, inline_svg, key, legend, plot_estimate


def body_facts(body: BodyOscillators) -> list[Fact]:
    """Return the key figures of oscillators with feedback from their servos."""
    bound = f"{body.strong_above:g} eps"
    slowest = formats.estimate(body.slowest, " eps", most=4)
    strong = f"{formats.number(body.strong.value, 0)} of {len(body.modes)}"
    growth = formats.estimate(body.growth, " eps")
    lifts = body.explicit_coupling
    explicit = "none is enough" if lifts.value is None else formats.estimate(lifts, " eps")
    return [
        Fact("Slowest pattern", slowest, "negative: grows"),
        Fact("Strong patterns", strong, f"relax faster than {bound}"),
        Fact("Growth for a while", growth, "the fastest of a deviation; negative: none"),
        Fact("Explicit coupling", explicit, f"between neighbours, lifts all to {bound}"),
    ]


def modes_drawing(body: BodyOscillators) -> Drawing:
    """Draw the rates at which patterns of phases relax, and those of a homogeneous chain.

    Args:
        body: With at least one mode.
    """
    count = len(body.modes)
    tooltips: dict[str, str] = {}
    hollow = {"markerfacecolor": "none", "linestyle": "none"}
    with drawing(2.9) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color=REFERENCE, linewidth=0.8, zorder=1)
        axes.axhline(body.strong_above, color=REFERENCE, linestyle=DASHED, zorder=1)
        others = body.comparator.real
        style = {"markersize": 6.0, "markeredgecolor": REFERENCE, **hollow}
        axes.plot(range(1, len(others) + 1), others, marker="D", zorder=2, **style)
        for k, mode in enumerate(body.modes, start=1):
            style = {"markersize": 4.6, "markeredgewidth": 1.0, "gid": f"mode-{k}"}
            plot_estimate(axes, k, mode.real, INK, bar=1.8, zorder=3, **style)
            tooltips[f"mode-{k}"] = f"pattern {k}: {formats.estimate(mode.real, ' eps', most=4)}"
        axes.set_xlim(0.4, count + 0.6)
        axes.set_xticks(range(1, count + 1))
        axes.set_xlabel("pattern of phases, the slowest first")
        axes.set_ylabel("rate of relaxing [eps]")
        legend(
            figure,
            key(color=INK, marker="o", markersize=4.6, label="this body, 95 %"),
            key(color=REFERENCE, marker="D", label="a homogeneous chain as strong", **hollow),
            key(color=REFERENCE, linestyle=DASHED, label=f"{body.strong_above:g} eps: strong"),
        )
        title = "Rates at which patterns of phases relax through the body"
        description = f"{count} patterns; the table below holds every number."
        svg = inline_svg(figure, "modes-figure", title, description, tooltips)
    return Drawing(
        svg,
        "What oscillators that feel their own servos would do without any other coupling, eps the "
        "strength of that feeling: a pattern above zero relaxes, below zero it grows. All phases "
        "together are left out: they neither relax nor grow.",
    )


def entrainment_entries(body: BodyOscillators) -> Entries | None:
    """Return P^-1 - I, the coupling relative to entrainment; None if P is singular."""
    relative = body.entrainment
    if relative.value is None:
        return None
    value = np.array(relative.value, dtype=np.float64)
    half = None if relative.ci95_half is None else np.array(relative.ci95_half, dtype=np.float64)
    symbol = "P\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ONE} \N{MINUS SIGN} I"
    meaning = "P read as entrainment by the commands: coupling relative to it [1]"
    words = ("the joint that follows", "the joint that it follows")
    return Entries(symbol, meaning, body.joints, body.joints, value, half, *words)
