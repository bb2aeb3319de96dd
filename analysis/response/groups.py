"""Find the joints that share a rhythm, from their commands.

The gait of a snake robot may have a frequency for each plane (omega_h and omega_v in Eqs. 2 and 6
of Meister et al., 2011) or for any other part of its joints. Each channel's own frequency is
estimated, and channels whose frequencies the record's length T can't resolve are one group: two
tones closer than about 1.5/T can't be told apart in a response that holds both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

from ..estimators.harmonic import HarmonicFit, fit_at
from ..estimators.series import Series
from .mixing import COINCIDENT, RESOLUTION, group_model
from .rhythm import DRIVEN_SHARE, MIN_EXPLAINED, Rhythm, find_rhythm, refine

_CLEAR = 0.98
"""A command explained to less than this may have a frequency of its own: a tenth of a cycle over
the record off leaves 3 %."""

_OWN_SHARE = 0.02
"""A channel whose fundamental has less than this share of its harmonics' power has another one."""

_SAME = 0.1
"""Frequencies closer than this many cycles over the record are the same."""

_SIGMAS = 5.0
"""And so are those closer than this many standard errors."""


@dataclass(frozen=True)
class Unresolved:
    """Joints at two frequencies that the record is too short to separate.

    Attributes:
        kept: Names of those that are analysed with one frequency.
        left: Names of those that are not analysed; none where one frequency fits all.
        low_hz: Lowest frequency [Hz].
        high_hz: Highest frequency [Hz].
    """

    kept: tuple[str, ...]
    left: tuple[str, ...]
    low_hz: float
    high_hz: float


@dataclass(frozen=True)
class Groups:
    """Channels by rhythm.

    Attributes:
        rhythms: One a group, the largest group first.
        explained: Share of all moving channels' variance that their groups' rhythms explain, or
            rhythms of their own that are not resolved.
        unresolved: Groups that hold, or are beside, a frequency that is too close.
        astray: Names of channels that move, but not by a rhythm of a group.
    """

    rhythms: tuple[Rhythm, ...]
    explained: float
    unresolved: tuple[Unresolved, ...] = ()
    astray: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Tone:
    """A channel's own rhythm."""

    series: Series
    rhythm: Rhythm

    @property
    def error(self) -> float:
        """Standard error of its frequency in white noise [rad/s]."""
        information = float(np.sum(self.rhythm.fit.weight * self.rhythm.fit.information))
        return information**-0.5 if information > 0 else float("inf")


def find_groups(series: Sequence[Series], duration_s: float) -> Groups | None:
    """Find the rhythms of the channels.

    Args:
        series: Channels with names of their own; those that never move are ignored.
        duration_s: Length of the stretch [s].

    Returns:
        The groups; a single one, however little it explains, where channels have no rhythms of
        their own. None where there is no rhythm at all.
    """
    common = find_rhythm(series, duration_s)
    if common is None:
        return None
    moving = [one for one in series if one.name in common.names]
    lively = _lively(common.fit)
    if np.all(_own(common.fit)[lively]):
        return Groups((common,), common.explained)
    active = [one for one, chosen in zip(moving, lively, strict=True) if chosen]
    tones = [
        _Tone(one, rhythm)
        for one in active
        if (rhythm := find_rhythm([one], duration_s)) is not None
        and rhythm.explained >= MIN_EXPLAINED
        and _fundamental_share(rhythm.fit)[0] >= _OWN_SHARE
    ]
    bin_rad_s = 2 * np.pi / duration_s
    rhythms: list[Rhythm] = []
    unresolved: list[Unresolved] = []
    for cluster in _clusters(tones, RESOLUTION * bin_rad_s):
        rhythm, close = _one_rhythm(cluster, _SAME * bin_rad_s)
        rhythms += [] if rhythm is None else [rhythm]
        unresolved += [] if close is None else [close]
    alone = len(rhythms) == 1 and abs(rhythms[0].omega - common.omega) < COINCIDENT * bin_rad_s
    if not rhythms or (alone and not any(close.left for close in unresolved)):
        return Groups((common,), common.explained, tuple(unresolved))
    left = {name for close in unresolved for name in close.left}
    grouped = {name for rhythm in rhythms for name in rhythm.names}
    rest = [one for one in active if one.name not in grouped | left]
    rhythms = _with_compound(rhythms, active, rest, duration_s)
    rhythms.sort(key=lambda one: (-len(one.names), -float(one.fit.total.sum()), one.omega))
    total = float(common.fit.total.sum())
    undecided = [one.rhythm for one in tones if one.series.name in left]
    known = sum(float((one.fit.total - one.fit.rss).sum()) for one in (*rhythms, *undecided))
    grouped = {name for rhythm in rhythms for name in rhythm.names}
    astray = tuple(one.name for one in active if one.name not in grouped | left)
    return Groups(tuple(rhythms), known / total, tuple(unresolved), astray)


def _lively(fit: HarmonicFit) -> BoolArray:
    size = np.sqrt(fit.total / fit.count)
    return size > DRIVEN_SHARE * np.max(size, initial=0.0)


def _own(fit: HarmonicFit) -> BoolArray:
    """Return whether the common rhythm is each channel's own and not a subharmonic of it."""
    return (fit.explained >= _CLEAR) & (_fundamental_share(fit) >= _OWN_SHARE)


def _fundamental_share(fit: HarmonicFit) -> FloatArray:
    """Return the share of the fundamental in the power of each channel's harmonics, shape (K,)."""
    power = np.abs(fit.amplitudes) ** 2
    total = power.sum(axis=1)
    return np.divide(power[:, 0], total, out=np.zeros_like(total), where=total > 0)


def _clusters(tones: Sequence[_Tone], apart: float) -> list[list[_Tone]]:
    """Tones whose frequencies have no gap wider than ``apart`` [rad/s] between them."""
    ordered = sorted(tones, key=lambda one: one.rhythm.omega)
    clusters: list[list[_Tone]] = [ordered[:1]] if ordered else []
    for before, after in pairwise(ordered):
        if after.rhythm.omega - before.rhythm.omega < apart:
            clusters[-1].append(after)
        else:
            clusters.append([after])
    return clusters


def _one_rhythm(cluster: Sequence[_Tone], same: float) -> tuple[Rhythm | None, Unresolved | None]:
    """Return the rhythm of a cluster, and whether it holds frequencies that differ."""
    parts: list[list[_Tone]] = [[cluster[0]]]
    for before, after in pairwise(cluster):
        doubt = _SIGMAS * float(np.hypot(before.error, after.error))
        if after.rhythm.omega - before.rhythm.omega > max(same, doubt):
            parts.append([after])
        else:
            parts[-1].append(after)
    rhythm = _shared(cluster)
    if len(parts) == 1:
        return rhythm, None
    low, high = (cluster[k].rhythm.omega / (2 * np.pi) for k in (0, -1))
    names = tuple(one.series.name for one in cluster)
    if rhythm is not None and np.all(rhythm.fit.explained >= MIN_EXPLAINED):
        return rhythm, Unresolved(names, (), low, high)
    largest = max(
        parts, key=lambda part: (len(part), sum(float(t.rhythm.fit.total.sum()) for t in part))
    )
    kept = tuple(one.series.name for one in largest)
    left = tuple(name for name in names if name not in kept)
    return _shared(largest), Unresolved(kept, left, low, high)


def _shared(tones: Sequence[_Tone]) -> Rhythm | None:
    """One rhythm of several channels, in their order in the chain."""
    omega = float(np.mean([one.rhythm.omega for one in tones]))
    return refine([one.series for one in tones], omega)


def _with_compound(
    rhythms: Sequence[Rhythm], active: Sequence[Series], rest: Sequence[Series], duration_s: float
) -> list[Rhythm]:
    """Fit the groups with each other's tones; a channel of several goes where its largest is."""
    omegas = [one.omega for one in rhythms]
    names = [set(one.names) for one in rhythms]

    def fitted(series: Sequence[Series], group: int) -> HarmonicFit | None:
        model = group_model(series, omegas, group, duration_s)
        enough = all(one.count > model.size + 1 for one in series)
        return fit_at(series, omegas[group], model) if enough else None

    for one in rest:
        found = [fit for group in range(len(omegas)) if (fit := fitted([one], group)) is not None]
        if len(found) == len(omegas) and found[0].explained[0] >= MIN_EXPLAINED:
            names[int(np.argmax([abs(fit.fundamental[0]) for fit in found]))].add(one.name)
    result: list[Rhythm] = []
    for group, rhythm in enumerate(rhythms):
        members = [one for one in active if one.name in names[group]]
        fit = fitted(members, group)
        if fit is None or (len(rhythms) == 1 and len(members) == len(rhythm.names)):
            result.append(rhythm)
        else:
            result.append(Rhythm(tuple(one.name for one in members), fit))
    return result
