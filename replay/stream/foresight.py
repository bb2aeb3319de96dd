"""What a recording will hold once its session is analysed, as far as that can be told before.

The viewer gets its layout before anything is computed. Views that fill later are there from the
start, so that nothing has to move, or to lose its camera and its place in time, when they do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..content.content import AwaitedMap, Content
from ..content.entities import ENERGY, GAIN, LAG, MAPS, Chart, MeanCycle, Quantity, Series
from ..draw.cycles import mean_cycle
from ..draw.cycles.heat_maps import POWER
from ..draw.cycles.steps import CYCLES
from ..layout.views import build_views
from ..samples.timeline import Rhythm


def foreseen(content: Content, rhythm: Rhythm | None) -> Content:
    """Add what an analysis adds to a session like this.

    Args:
        content: What there is without it.
        rhythm: The gait's phase, or None where none was logged.

    Returns:
        What there will be: bars where joints are commanded and measured; maps, steps and a mean
        cycle where the gait's phase was logged too.
    """
    if not content.commanded or not content.measured:
        return content
    has_power = bool(content.joint_power)
    quantities = (GAIN, LAG, *((ENERGY,) if has_power else ()))
    charts = tuple(Chart(one.key, _title(one), ()) for one in quantities)
    if rhythm is None:
        return replace(content, charts=charts)
    measured = _names(content.measured)
    maps = (GAIN, LAG, *((POWER,) if has_power else ()))
    return replace(
        content,
        charts=charts,
        maps=tuple(_map(one) for one in maps),
        cycles=tuple((one, (Series(f"{CYCLES}/{one.key}", measured),)) for one in quantities),
        mean=MeanCycle(
            period_s=_period_s(rhythm),
            has_body=content.start is not None,
            has_places=content.places is not None,
            measured=(Series(f"{mean_cycle.ENSEMBLE}/measured", measured),),
            error=_mean_series("error", _names(content.errors)),
            power=_mean_series("power", _names(content.joint_power)),
        ),
    )


def same_arrangement(first: Content, other: Content) -> bool:
    """Whether two contents have the same views, so that one's layout does for the other.

    Args:
        first: What a recording holds.
        other: What another one holds.

    Returns:
        Whether their views differ in nothing but titles.
    """
    return _arrangement(first) == _arrangement(other)


def _arrangement(content: Content) -> tuple[object, ...]:
    views = tuple(
        (type(view).__name__, str(view.origin), str(view.contents))
        for view in build_views(content).all
    )
    mean = content.mean
    lines = () if mean is None else (mean.measured, mean.error, mean.power)
    return views, lines, content.modes > 1


def _title(quantity: Quantity) -> str:
    unit, _, _ = quantity.unit.partition("/")  # what is one a cycle is so in its bar
    return f"{quantity.name} [{unit}]"


def _names(series: tuple[Series, ...]) -> tuple[str, ...]:
    return tuple(name for one in series for name in one.names)


def _mean_series(kind: str, names: tuple[str, ...]) -> tuple[Series, ...]:
    return (Series(f"{mean_cycle.ENSEMBLE}/{kind}", names),) if names else ()


def _map(quantity: Quantity) -> AwaitedMap:
    return AwaitedMap(f"{MAPS}/{quantity.key}", f"{quantity.name} map [{quantity.unit}]")


def _period_s(rhythm: Rhythm) -> float:
    cycles = abs(float(rhythm.cycles[-1] - rhythm.cycles[0]))
    return float(np.ptp(rhythm.t_ns)) * 1e-9 / cycles
