"""The joints that stand out and the shape of the rest, over all planes of a session."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import plain
from undulog.capture.judgement.levels import reaches

from ...common.answer import Shape, StandOut
from ...estimators.intervals import EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD, equivalence_p
from ...response.response import Response
from .kinds import Split, split_of
from .outliers import LOCAL, Deviation, standing_out
from .profile import (
    LEVEL,
    MIN_JOINTS,
    Contrast,
    Profile,
    Scatter,
    contrasts,
    critical_value,
    family_of,
    scatter_of,
)

_MARGINS = {"gain": EQUIVALENT_GAIN, "lag": EQUIVALENT_LAG_RAD}
OFFSET_RAD = EQUIVALENT_LAG_RAD
"""Offsets below this are of no interest [rad]."""

_MIN_CYCLES = MIN_JOINTS


@dataclass(frozen=True)
class Chain:
    """Joints that are compared with each other: one plane and one rhythm.

    Attributes:
        plane: ``horizontal``, ``vertical`` or ``chain``.
        group: Index of the rhythm group.
        commanded: Names of all commanded joints of it, head to tail.
        names: Those of them that are compared, in the same order, m of them.
        response: Of these, shape (m,), with errors.
        offsets: Mean of the position less that of the command, cycle by cycle [rad], by name.
        scatter: Errors of log gain and of lag; None where they are those of the response.
        loaded: Names of joints at a limit of their servo beside others that are, too: what
            they do is their load's doing, and no joint's own.
    """

    plane: str
    group: int
    commanded: tuple[str, ...]
    names: tuple[str, ...]
    response: Response
    offsets: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    scatter: tuple[Scatter, Scatter] | None = None
    loaded: frozenset[str] = frozenset()

    @property
    def errors(self) -> tuple[Scatter, Scatter] | None:
        """Errors of log gain and of lag; None where they are not known."""
        if self.scatter is not None:
            return self.scatter
        return None if self.response.errors is None else scatter_of(self.response.errors)


@dataclass(frozen=True)
class Findings:
    """What the comparison of the joints shows.

    Attributes:
        stand_out: Joints that stand out, worst first.
        shape: Shapes of the rest whose simultaneous interval excludes zero; those that explain
            most come first.
        undecided: Planes and groups in which joints differ and which one can't be decided.
        alike: Whether the rest of the compared joints is shown to be alike; None where it isn't.
        compared: Names of the joints that were compared.
        kinds: Two kinds of joints, a clause each, where there are such.
        boundary: First and last joints that differ from the middle as no others do.
    """

    stand_out: tuple[StandOut, ...] = ()
    shape: tuple[Shape, ...] = ()
    undecided: tuple[tuple[str, int], ...] = ()
    alike: bool | None = None
    compared: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    boundary: tuple[tuple[str, str], ...] = ()


def examine(chains: Iterable[Chain]) -> Findings:
    """Compare the joints of each chain with each other.

    Args:
        chains: One a plane and rhythm; those of fewer than two joints are left out.

    Returns:
        The findings, all of one family-wise level.
    """
    some: list[Chain] = []
    kinds: list[str] = []
    for chain in chains:
        if len(chain.names) > 1 and chain.errors is not None:
            parts, clause = _by_kind(chain)
            some += parts
            kinds += [clause] if clause else []
    profiles = [
        (chain, quantity, profile_of(chain, quantity)) for chain in some for quantity in _MARGINS
    ]
    critical = critical_value([family_of(profile) for _, _, profile in profiles], LEVEL)
    out: list[StandOut] = []
    shapes: list[tuple[float, Shape]] = []
    undecided: dict[tuple[str, int], None] = {}
    boundary: dict[tuple[str, str], None] = {}
    excluded: dict[int, set[int]] = {id(chain): set() for chain in some}
    for chain, quantity, profile in profiles:
        if len(chain.names) < MIN_JOINTS:
            continue
        for deviation in standing_out(profile, critical):
            if chain.names[deviation.joint] in chain.loaded:
                continue
            excluded[id(chain)].add(deviation.joint)
            out.append(_stand_out(chain, deviation.joint, quantity, deviation, critical))
    for chain in some:
        out += _offset(chain, critical)
    for chain, quantity, profile in profiles:
        active = np.ones(len(chain.names), dtype=np.bool_)
        active[list(excluded[id(chain)])] = False
        half = float(np.var(profile.values[active])) / 2
        significant = [
            contrast
            for contrast in contrasts(profile, active)
            if reaches(abs(contrast.value), critical * contrast.error, profile.margin)
            and (contrast.kind == "each" or contrast.spread**2 >= half)
        ]
        if len(chain.names) < MIN_JOINTS:
            if significant:
                undecided[chain.plane, chain.group] = None
            continue
        if any(contrast.kind == "ends" for contrast in significant) and _spikes(
            profile.values[active]
        ):
            names = [name for name, there in zip(chain.names, active, strict=True) if there]
            boundary[names[0], names[-1]] = None
        shapes += [
            (contrast.spread / _MARGINS[quantity], _shape(chain, quantity, contrast, critical))
            for contrast in significant
        ]
    alike = bool(some) and all(_alike(chain, excluded[id(chain)]) for chain in some)
    alike = alike and not (shapes or kinds)
    out.sort(key=lambda joint: -abs(joint.deviation) / _MARGINS.get(joint.quantity, OFFSET_RAD))
    return Findings(
        stand_out=_ranked(out),
        shape=tuple(shape for _, shape in sorted(shapes, key=lambda ranked: -ranked[0])),
        undecided=tuple(undecided),
        alike=True if alike else None,
        boundary=tuple(boundary),
        kinds=tuple(kinds),
        compared=tuple(name for chain in some for name in chain.names),
    )


def _spikes(values: FloatArray) -> bool:
    """Return whether the joints beside the ends don't follow the ends away from the middle."""
    if values.size < MIN_JOINTS + 1:  # no middle beside the ends and their neighbours
        return False
    away = values - np.median(values[2:-2])
    beside = max(abs(float(away[1])), abs(float(away[-2])))
    return beside < LOCAL * abs(float(away[0] + away[-1])) / 2


def _by_kind(chain: Chain) -> tuple[list[Chain], str]:
    """Divide a chain into two kinds of joints, if it has two; return the parts and a clause."""
    splits = [
        (quantity, split)
        for quantity, margin in _MARGINS.items()
        if (split := split_of(profile_of(chain, quantity).values, margin)) is not None
    ]
    if not splits:
        return [chain], ""
    _, split = max(splits, key=lambda entry: entry[1].sure)
    parts = [_part(chain, index.tolist()) for index in (split.first, split.second)]
    sizes = [_between(chain, quantity, split) for quantity in _MARGINS]
    names = [f"{len(part.names)} as {plain(part.names[0])}" for part in parts]
    differences = " and ".join(size for size in sizes if size)
    return parts, f"two kinds of joints: {names[0]}, {names[1]} with {differences}"


def _part(chain: Chain, index: list[int]) -> Chain:
    scatter = chain.scatter
    if scatter is not None:
        scatter = scatter[0].select(index), scatter[1].select(index)
    names = tuple(chain.names[k] for k in index)
    return replace(chain, names=names, response=chain.response.select(index), scatter=scatter)


def _between(chain: Chain, quantity: str, split: Split) -> str:
    """How the second kind differs from the first in one quantity; empty within the margin."""
    values = profile_of(chain, quantity).values
    size = float(np.median(values[split.second]) - np.median(values[split.first]))
    if abs(size) < _MARGINS[quantity]:
        return ""
    if quantity == "gain":
        return f"{100 * abs(math.expm1(size)):.2g} % {'less' if size < 0 else 'more'} gain"
    return f"{math.degrees(abs(size)):.2g}° {'less' if size < 0 else 'more'} lag"


def profile_of(chain: Chain, quantity: str) -> Profile:
    """Return the profile of one quantity along a chain.

    Args:
        quantity: ``gain`` (as its logarithm) or ``lag``.

    Raises:
        ValueError: If the response carries no errors.
    """
    response = chain.response
    if chain.errors is None:
        raise ValueError("the response carries no errors to judge contrasts by")
    gains, lags = chain.errors
    place = np.array([chain.commanded.index(name) for name in chain.names], dtype=np.float64)
    count = len(chain.commanded)
    if quantity == "gain":
        return Profile(place, count, np.log(response.gain), gains, math.log1p(_MARGINS["gain"]))
    return Profile(place, count, response.lag_near_mean_rad, lags, _MARGINS["lag"])


def _offset(chain: Chain, critical: float) -> list[StandOut]:
    """Return the joints whose mean stands off their command's as no other joint's does.

    Their errors come from the scatter between cycles, so they are outside the family of gain and
    lag; the margin is many times what noise makes of a mean.
    """
    recorded = {name for name, offset in chain.offsets.items() if offset.size >= _MIN_CYCLES}
    index = [k for k, name in enumerate(chain.names) if name in recorded]
    if len(index) < MIN_JOINTS:
        return []
    cycles = min(chain.offsets[chain.names[k]].size for k in index)
    rows = np.stack([chain.offsets[chain.names[k]][:cycles] for k in index])
    values = np.median(rows, axis=1)
    columns = (rows - rows.mean(axis=1, keepdims=True)) / math.sqrt(cycles - 1)
    nothing = np.zeros(len(index))
    place = np.array([chain.commanded.index(chain.names[k]) for k in index], dtype=np.float64)
    scatter = Scatter(columns, nothing, nothing)
    profile = Profile(place, len(chain.commanded), values, scatter, OFFSET_RAD)
    return [
        _stand_out(chain, index[deviation.joint], "offset", deviation, critical)
        for deviation in standing_out(profile, critical)
    ]


def _alike(chain: Chain, excluded: set[int]) -> bool:
    """Return whether the equivalence tests of gain and lag pass for the rest of a chain.

    Of fewer joints than can say which one differs nothing is claimed.
    """
    index = [k for k in range(len(chain.names)) if k not in excluded]
    if len(index) < MIN_JOINTS - 1 or len(chain.names) < MIN_JOINTS:
        return False
    # Each joint less the mean of the others.
    count = len(index)
    rows = (count * np.eye(count) - 1) / (count - 1)
    for quantity, margin in _MARGINS.items():
        profile = profile_of(chain, quantity)
        values = rows @ profile.values[index]
        scatter = profile.scatter.select(index)
        error = np.sqrt(scatter.variance(rows))
        dof = float(scatter.columns.shape[1])
        deviation = np.expm1(values) if quantity == "gain" else values
        if equivalence_p(deviation, error, dof, margin) >= LEVEL:
            return False
    return True


def _interval(value: float, half: float, quantity: str) -> tuple[float, tuple[float, float]]:
    if quantity == "gain":
        return math.expm1(value), (math.expm1(value - half), math.expm1(value + half))
    return value, (value - half, value + half)


def _stand_out(
    chain: Chain, joint: int, quantity: str, deviation: Deviation, critical: float
) -> StandOut:
    value, ci95 = _interval(deviation.value, critical * deviation.error, quantity)
    return StandOut(chain.names[joint], chain.plane, chain.group, 0, quantity, value, ci95)


def _shape(chain: Chain, quantity: str, contrast: Contrast, critical: float) -> Shape:
    value, ci95 = _interval(contrast.value, critical * contrast.error, quantity)
    joint = None if contrast.joint is None else chain.names[contrast.joint]
    return Shape(contrast.kind, quantity, chain.plane, chain.group, value, ci95, joint)


def _ranked(out: Sequence[StandOut]) -> tuple[StandOut, ...]:
    """Rank joints by their largest deviation; both quantities of a joint have its rank."""
    order = list(dict.fromkeys(deviation.joint for deviation in out))
    ranked = [replace(deviation, rank=1 + order.index(deviation.joint)) for deviation in out]
    return tuple(sorted(ranked, key=lambda deviation: deviation.rank))
