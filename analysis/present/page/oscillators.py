"""Coupled oscillators on the page: the couplings of a chain, and what the body couples."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ...results import formats
from ...results.estimate import Estimate
from ...results.oscillators import BodyOscillators, ChainCoupling
from ..text import chain_detail
from .matrix import Entries, matrix_picture
from .svg import INK, REFERENCE, WIDTH_IN, Drawing, drawing, inline_svg, key, legend, new_figure
from .tables import Fact

_DASHED = (0, (5, 3))


@dataclass(frozen=True)
class ChainView:
    """What the page shows of one chain of oscillators.

    Attributes:
        sentence: The answer, or None where it has none.
        matrix: The couplings as a picture; None where there are none.
        decimals: Digits after the point of K, of the rates and of the feedback.
        lags: Of the links [deg].
        lag_decimals: Digits after the point of them.
        fed: Whether any feedback is known.
    """

    chain: ChainCoupling
    sentence: str | None
    method: str
    matrix: Drawing | None
    decimals: tuple[int, int, int]
    lags: tuple[Estimate, ...]
    lag_decimals: int
    fed: bool


def chain_views(chains: Iterable[ChainCoupling]) -> tuple[ChainView, ...]:
    """The chains of a session.

    Returns:
        The same, ready for the page.
    """
    return tuple(_chain(one, f"oscillators-{k + 1}") for k, one in enumerate(chains))


def _chain(chain: ChainCoupling, prefix: str) -> ChainView:
    lines = list(chain_detail(chain))
    lags = tuple(formats.degrees(link.lag_rad) for link in chain.links)
    rates = chain.oscillators
    return ChainView(
        chain=chain,
        sentence=lines[0].partition(": ")[2] if chain.identifiable else None,
        method=lines[-1].removeprefix("Method: ") if chain.identifiable else "",
        matrix=matrix_picture(_couplings(chain), prefix) if chain.links else None,
        decimals=(
            formats.decimals_for((link.K for link in chain.links), most=3),
            formats.decimals_for((one.omega for one in rates), most=4),
            formats.decimals_for((one.feedback for one in rates), most=3),
        ),
        lags=lags,
        lag_decimals=formats.decimals_for(lags, most=2),
        fed=any(one.feedback.value is not None for one in rates),
    )


def _couplings(chain: ChainCoupling) -> Entries:
    """K as a matrix; what was not looked for is not a number."""
    names = tuple(one.name for one in chain.oscillators)
    place = {name: k for k, name in enumerate(names)}
    value: FloatArray = np.full((len(names), len(names)), np.nan)
    half: FloatArray = np.zeros_like(value)
    for link in chain.links:
        at = place[link.target], place[link.source]
        value[at] = link.K.value or 0.0
        if link.K.ci95 is not None:
            half[at] = (link.K.ci95[1] - link.K.ci95[0]) / 2
    return Entries(
        "K",
        f"coupling of oscillators, {chain.plane} [1/s]; looked for up to {chain.reach} apart",
        names,
        names,
        value,
        half,
        row="the oscillator that is turned",
        column="the oscillator that turns it",
        verb="is turned by",
    )


def body_facts(body: BodyOscillators) -> list[Fact]:
    """Key figures of oscillators that feel their servos."""
    patterns = len(body.modes)
    bound = f"{body.strong_above:g} eps"
    explicit = body.explicit_coupling
    return [
        Fact("Slowest pattern", formats.estimate(body.slowest, " eps", most=4), "negative: grows"),
        Fact(
            "Strong patterns",
            f"{formats.number(body.strong.value, 0)} of {patterns}",
            f"relax faster than {bound}",
        ),
        Fact(
            "Growth for a while",
            formats.estimate(body.growth, " eps"),
            "the fastest of a deviation; negative: none",
        ),
        Fact(
            "Explicit coupling",
            "none is enough" if explicit.value is None else formats.estimate(explicit, " eps"),
            f"between neighbours, lifts all to {bound}",
        ),
    ]


def modes_drawing(body: BodyOscillators, prefix: str) -> Drawing:
    """The rates at which patterns of phases relax, beside those of a homogeneous chain.

    Args:
        body: With at least one mode.
        prefix: For identifiers, unique in the page.
    """
    count = len(body.modes)
    tooltips: dict[str, str] = {}
    with drawing():
        figure = new_figure(WIDTH_IN, 2.9)
        axes = figure.subplots()
        axes.axhline(0.0, color=REFERENCE, linewidth=0.8, zorder=1)
        axes.axhline(body.strong_above, color=REFERENCE, linestyle=_DASHED, zorder=1)
        axes.plot(
            range(1, len(body.comparator.real) + 1),
            body.comparator.real,
            "D",
            markersize=6.0,
            markerfacecolor="none",
            markeredgecolor=REFERENCE,
            zorder=2,
        )
        for k, mode in enumerate(body.modes, start=1):
            if mode.real.ci95 is not None:
                axes.plot([k, k], mode.real.ci95, color=INK, linewidth=1.8, zorder=3)
            gid = f"mode-{k}"
            axes.plot([k], [mode.real.value], "o", color=INK, markersize=4.6, gid=gid, zorder=4)
            tooltips[gid] = f"pattern {k}: {formats.estimate(mode.real, ' eps', most=4)}"
        axes.set_xlim(0.4, count + 0.6)
        axes.set_xticks(range(1, count + 1))
        axes.set_xlabel("pattern of phases, the slowest first")
        axes.set_ylabel("rate of relaxing [eps]")
        strong = f"{body.strong_above:g} eps: strong"
        legend(
            figure,
            [
                key([], [], color=INK, marker="o", markersize=4.6, label="this body, 95 %"),
                key(
                    [],
                    [],
                    color=REFERENCE,
                    marker="D",
                    markerfacecolor="none",
                    linestyle="none",
                    label="a homogeneous chain as strong",
                ),
                key([], [], color=REFERENCE, linestyle=_DASHED, label=strong),
            ],
        )
        svg = inline_svg(
            figure,
            prefix=prefix,
            title="Rates at which patterns of phases relax through the body",
            description=f"{count} patterns; the table below holds every number.",
            tooltips=tooltips,
        )
    caption = (
        "What oscillators that feel their own servos would do without any other coupling, eps the "
        "strength of that feeling: a pattern above zero relaxes, below zero it grows. All phases "
        "together are left out: they neither relax nor grow."
    )
    return Drawing(svg, caption)


def entrainment_entries(body: BodyOscillators) -> Entries | None:
    """The other reading of P, as entrainment.

    Returns:
        P^-1 - I; None where P is singular.
    """
    relative = body.entrainment
    if relative.value is None:
        return None
    half = None if relative.ci95_half is None else np.array(relative.ci95_half, dtype=np.float64)
    return Entries(
        "P\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ONE} \N{MINUS SIGN} I",
        "P read as entrainment by the commands: coupling relative to it [1]",
        body.joints,
        body.joints,
        np.array(relative.value, dtype=np.float64),
        half,
        row="the joint that follows",
        column="the joint that it follows",
    )
