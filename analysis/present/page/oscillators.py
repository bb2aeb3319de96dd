"""Prepare coupled oscillators for the page: couplings of a chain, and patterns of the body."""

from __future__ import annotations

from typing import Any

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ...results import formats
from ...results.oscillators import BodyOscillators, ChainCoupling
from ..text import chain_detail
from .matrix import Entries, matrix_picture
from .svg import (
    DASHED,
    INK,
    REFERENCE,
    WIDTH_IN,
    Drawing,
    drawing,
    inline_svg,
    key,
    legend,
    new_figure,
    plot_estimate,
)
from .tables import Fact


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
            formats.decimals_for((one.omega for one in rates), most=4),
            formats.decimals_for((one.feedback for one in rates), most=3),
        ),
        "lags": lags,
        "lag_decimals": formats.decimals_for(lags, most=2),
        "fed": any(one.feedback.value is not None for one in rates),
    }


def _couplings(chain: ChainCoupling) -> Entries:
    """Return K as a matrix with NaN for couplings that were not estimated."""
    names = tuple(one.name for one in chain.oscillators)
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


def body_facts(body: BodyOscillators) -> list[Fact]:
    """Return the key figures of oscillators with feedback from their servos."""
    bound = f"{body.strong_above:g} eps"
    slowest = formats.estimate(body.slowest, " eps", most=4)
    strong = f"{formats.number(body.strong.value, 0)} of {len(body.modes)}"
    growth = formats.estimate(body.growth, " eps")
    explicit = "none is enough"
    if body.explicit_coupling.value is not None:
        explicit = formats.estimate(body.explicit_coupling, " eps")
    return [
        Fact("Slowest pattern", slowest, "negative: grows"),
        Fact("Strong patterns", strong, f"relax faster than {bound}"),
        Fact("Growth for a while", growth, "the fastest of a deviation; negative: none"),
        Fact("Explicit coupling", explicit, f"between neighbours, lifts all to {bound}"),
    ]


def modes_drawing(body: BodyOscillators, prefix: str) -> Drawing:
    """Draw the rates at which patterns of phases relax, and those of a homogeneous chain.

    Args:
        body: With at least one mode.
        prefix: For identifiers, unique in the page.
    """
    count = len(body.modes)
    tooltips: dict[str, str] = {}
    hollow = {"markerfacecolor": "none", "linestyle": "none"}
    with drawing():
        figure = new_figure(WIDTH_IN, 2.9)
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
        svg = inline_svg(figure, prefix, title, description, tooltips)
    caption = (
        "What oscillators that feel their own servos would do without any other coupling, eps the "
        "strength of that feeling: a pattern above zero relaxes, below zero it grows. All phases "
        "together are left out: they neither relax nor grow."
    )
    return Drawing(svg, caption)


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
