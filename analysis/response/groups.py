"""Find the joints that share a rhythm, from their commands.

The gait of a snake robot may have a frequency for each plane (omega_h and omega_v in Eqs. 2 and 6
of Meister et al., 2011) or for any other part of its joints. Each channel's own frequency is
estimated, and channels whose frequencies the record's length T can't resolve are one group: two
tones closer than about 1.5/T can't be separated in a response that holds both.

Each response holds the other groups' tones, so the model of every channel has the harmonics of all
groups, and coincident ones, as 2 omega_1 and 3 omega_2 at 3:2, only once (:func:`group_model`).
A nonlinear body makes tones at m omega_1 + n omega_2, too. Those that stand out of the noise near
a group's tone are fitted with it, or they would count as noise (:func:`with_mixed_lines`); one that
falls on the tone itself can't be separated from the response (:func:`mixed_tones`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from scipy.special import gammainccinv

from undulog.capture.common.arrays import FloatArray

from ..estimators.harmonic import HarmonicFit, HarmonicModel, chunks, fit_at
from ..estimators.series import Series, shared_times
from ..estimators.spectrum import residual_noise
from .rhythm import (
    DRIVEN_SHARE,
    HARMONICS,
    MIN_EXPLAINED,
    NYQUIST_SHARE,
    Rhythm,
    allowed_model,
    find_rhythm,
    refine,
)

_CLEAR = 0.98
"""A command explained to less than this may have a frequency of its own: a tenth of a cycle over
the record off leaves 3 %."""

_OWN_SHARE = 0.02
"""A channel whose fundamental has less than this share of its harmonics' power has another one."""

_SAME = 0.1
"""Frequencies closer than this many cycles over the record are the same."""

_SIGMAS = 5.0
"""And so are those closer than this many standard errors."""

RESOLUTION = 1.5
"""Frequencies closer than this many cycles over the record are not resolved."""

COINCIDENT = 0.5
"""Harmonics of two groups closer than this many cycles over the record are one column."""

MIXING_ORDER = 6
"""Highest |m| + |n| of a tone m f1 + n f2 that is looked for at a group's tone."""

MODELLED_ORDER = 11
"""Highest |m| + |n| of a mixed tone that is looked for beside a group's tone."""

_FAR = 30.0
"""Cycles over the record from a group's tone beyond which a tone hardly reaches its noise."""

_APART = 0.75
"""Mixed tones closer to another line than this many cycles over the record are left out."""

_ORTHOGONAL = 1.0
"""Mixed tones closer to the group's own than this many cycles over the record are part of it: tones
whole cycles apart are orthogonal, and up to 1.5 apart a line costs 5 % of the variance."""

_MOST_MIXED = 24
"""Mixed tones that are fitted at most, the strongest first."""

_CHANCE = 1e-3
"""Chance of fitting a mixed tone that is none, for each group."""

_SAMPLES_PER_LINE = 8
"""Samples that a channel needs for each line beside the group's harmonics."""


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
    moving = [channel for channel in series if channel.name in common.names]
    size = np.sqrt(common.fit.total / common.fit.count)
    lively = size > DRIVEN_SHARE * np.max(size, initial=0.0)
    # Whether the common rhythm is each channel's own and not a subharmonic of it.
    fundamental = (common.fit.explained >= _CLEAR) & (_fundamental_share(common.fit) >= _OWN_SHARE)
    if np.all(fundamental[lively]):
        return Groups((common,), common.explained)
    active = [channel for channel, chosen in zip(moving, lively, strict=True) if chosen]
    tones = [
        _Tone(channel, rhythm)
        for channel in active
        if (rhythm := find_rhythm([channel], duration_s)) is not None
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
    rest = [channel for channel in active if channel.name not in grouped | left]
    rhythms = _with_compound(rhythms, active, rest, duration_s)
    rhythms.sort(
        key=lambda rhythm: (-len(rhythm.names), -float(rhythm.fit.total.sum()), rhythm.omega)
    )
    total = float(common.fit.total.sum())
    undecided = [tone.rhythm for tone in tones if tone.series.name in left]
    explained = sum(
        float((rhythm.fit.total - rhythm.fit.rss).sum()) for rhythm in (*rhythms, *undecided)
    )
    grouped = {name for rhythm in rhythms for name in rhythm.names}
    astray = tuple(channel.name for channel in active if channel.name not in grouped | left)
    return Groups(tuple(rhythms), explained / total, tuple(unresolved), astray)


def _fundamental_share(fit: HarmonicFit) -> FloatArray:
    """Return the share of the fundamental in the power of each channel's harmonics, shape (K,)."""
    power = np.abs(fit.amplitudes) ** 2
    total = power.sum(axis=1)
    return np.divide(power[:, 0], total, out=np.zeros_like(total), where=total > 0)


def _clusters(tones: Sequence[_Tone], apart: float) -> list[list[_Tone]]:
    """Tones whose frequencies have no gap wider than ``apart`` [rad/s] between them."""
    ordered = sorted(tones, key=lambda tone: tone.rhythm.omega)
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
    names = tuple(tone.series.name for tone in cluster)
    if rhythm is not None and np.all(rhythm.fit.explained >= MIN_EXPLAINED):
        return rhythm, Unresolved(names, (), low, high)
    largest = max(
        parts, key=lambda part: (len(part), sum(float(t.rhythm.fit.total.sum()) for t in part))
    )
    kept = tuple(tone.series.name for tone in largest)
    left = tuple(name for name in names if name not in kept)
    return _shared(largest), Unresolved(kept, left, low, high)


def _shared(tones: Sequence[_Tone]) -> Rhythm | None:
    """One rhythm of several channels, in their order in the chain."""
    omega = float(np.mean([tone.rhythm.omega for tone in tones]))
    return refine([tone.series for tone in tones], omega)


def _with_compound(
    rhythms: Sequence[Rhythm], active: Sequence[Series], rest: Sequence[Series], duration_s: float
) -> list[Rhythm]:
    """Fit the groups with each other's tones; a channel of several goes where its largest is."""
    omegas = [rhythm.omega for rhythm in rhythms]
    names = [set(rhythm.names) for rhythm in rhythms]

    def fitted(series: Sequence[Series], group: int) -> HarmonicFit | None:
        model = group_model(series, omegas, group, duration_s)
        enough = all(channel.count > model.size + 1 for channel in series)
        return fit_at(series, omegas[group], model) if enough else None

    for remaining in rest:
        fits = [
            fit for group in range(len(omegas)) if (fit := fitted([remaining], group)) is not None
        ]
        if len(fits) == len(omegas) and fits[0].explained[0] >= MIN_EXPLAINED:
            names[int(np.argmax([abs(fit.fundamental[0]) for fit in fits]))].add(remaining.name)
    result: list[Rhythm] = []
    for group, rhythm in enumerate(rhythms):
        members = [channel for channel in active if channel.name in names[group]]
        fit = fitted(members, group)
        if fit is None or (len(rhythms) == 1 and len(members) == len(rhythm.names)):
            result.append(rhythm)
        else:
            result.append(Rhythm(tuple(member.name for member in members), fit))
    return result


@dataclass(frozen=True)
class MixedTone:
    """A harmonic of a group, or a tone of two groups together, that falls on a group's own tone.

    Attributes:
        group: Index of the group on whose frequency it falls.
        factors: Whole factor of each group's frequency in it, by index; none of them is 0, and
            the sum is above 0.
    """

    group: int
    factors: Mapping[int, int]


def group_model(
    series: Sequence[Series], omegas: Sequence[float], group: int, duration_s: float
) -> HarmonicModel:
    """Return the basis of a group's channels: own harmonics, and those of the other groups.

    Args:
        omegas: Angular frequencies of all groups [rad/s].
        duration_s: Length of the record [s].

    Returns:
        As many lines as the slowest channel's sampling rate and samples allow.
    """
    model = allowed_model(series, omegas[group])
    lines = further_lines(omegas, group, model.harmonics, _highest(series), duration_s)
    return replace(model, lines=lines[: _most_lines(series)])


def further_lines(
    omegas: Sequence[float], group: int, harmonics: int, highest: float, duration_s: float
) -> tuple[float, ...]:
    """Return the frequencies of the other groups' harmonics, for the model of one group's channels.

    Args:
        omegas: Angular frequencies of all groups [rad/s].
        harmonics: How many harmonics of its own its model has.
        highest: Highest frequency that the sampling rate allows [rad/s].
        duration_s: Length of the record [s].

    Returns:
        Angular frequencies [rad/s] without those that coincide with an own harmonic, with zero or
        with each other.
    """
    near = COINCIDENT * 2 * np.pi / duration_s
    taken = [0.0, *(order * omegas[group] for order in range(1, harmonics + 1))]
    lines: list[float] = []
    for order in range(1, HARMONICS + 1):
        for k, omega in enumerate(omegas):
            line = order * omega
            apart = min(abs(line - other) for other in (*taken, *lines))
            if k != group and line <= highest and apart > near:
                lines.append(line)
    return tuple(lines)


def with_mixed_lines(
    responses: Sequence[Series],
    omegas: Sequence[float],
    group: int,
    model: HarmonicModel,
    duration_s: float,
) -> HarmonicModel:
    """Add the mixed tones that stand out of the noise beside a group's tone, strongest first.

    Args:
        responses: Of the group's joints, k of them.
        omegas: Angular frequencies of all groups [rad/s].
        model: From :func:`group_model`.
        duration_s: Length of the record [s].

    Returns:
        The model with these lines; the periodogram of what it leaves, over the noise level and
        averaged over the channels, is nowhere larger at a mixed tone of order up to
        ``MODELLED_ORDER`` than noise explains (a gamma variable of shape k).
    """
    omega = omegas[group]
    bin_rad_s = 2 * np.pi / duration_s
    candidates: list[float] = _candidates(omegas, group, model, _highest(responses), bin_rad_s)
    most = min(_MOST_MIXED, _most_lines(responses) - len(model.lines))
    for _ in range(max(most, 0)):
        if not candidates:
            break
        fit = fit_at(responses, omega, model)
        level = residual_noise(responses, fit).level
        power = _periodogram(responses, fit, np.array(candidates, dtype=np.float64))
        noisy = level > 0
        total = np.sum(power[noisy] / level[noisy, None], axis=0)
        best = int(np.argmax(total))
        shape = max(int(np.count_nonzero(noisy)), 1)
        if float(total[best]) <= float(gammainccinv(shape, _CHANCE / len(candidates))):
            break
        line = candidates[best]
        model = replace(model, lines=(*model.lines, line))
        candidates = [
            candidate for candidate in candidates if abs(candidate - line) > _APART * bin_rad_s
        ]
    return model


def mixed_tones(omegas: Sequence[float], duration_s: float) -> list[MixedTone]:
    """Find the tones of other groups, or of several together, that fall on a group's own tone.

    Args:
        omegas: Angular frequencies of the groups [rad/s].
        duration_s: Length of the record [s].

    Returns:
        For each group the tone of lowest order |m| + |n|, up to ``MIXING_ORDER``, that the record
        does not resolve from it.
    """
    near = RESOLUTION * 2 * np.pi / duration_s
    tones: list[MixedTone] = []
    for group, omega in enumerate(omegas):
        for factors in _combinations(len(omegas), MIXING_ORDER):
            tone = sum(factor * omegas[k] for k, factor in factors.items())
            if factors != {group: 1} and abs(abs(tone) - omega) < near:
                sign = 1 if tone > 0 else -1
                tones.append(MixedTone(group, {k: sign * factor for k, factor in factors.items()}))
                break
    return tones


def _highest(series: Sequence[Series]) -> float:
    """Highest frequency that the slowest channel's sampling rate allows [rad/s]."""
    return NYQUIST_SHARE * 2 * np.pi / max(channel.period_s for channel in series)


def _most_lines(series: Sequence[Series]) -> int:
    return min(channel.count for channel in series) // _SAMPLES_PER_LINE


def _candidates(
    omegas: Sequence[float], group: int, model: HarmonicModel, highest: float, bin_rad_s: float
) -> list[float]:
    """Mixed tones near a group's tone, resolved from it, its harmonics and the lines there are."""
    omega = omegas[group]
    modelled = [0.0, *(order * omega for order in range(1, model.harmonics + 1))]
    mixed: list[float] = []
    for factors in _combinations(len(omegas), MODELLED_ORDER):
        line = abs(sum((factor * omegas[k] for k, factor in factors.items()), 0.0))
        resolved = min(abs(line - other) for other in modelled) > _ORTHOGONAL * bin_rad_s
        apart = min((abs(line - other) for other in model.lines), default=float("inf"))
        near = abs(line - omega) <= _FAR * bin_rad_s
        if near and line <= highest and resolved and apart > _APART * bin_rad_s:
            mixed.append(line)
    return mixed


def _periodogram(series: Sequence[Series], fit: HarmonicFit, omegas: FloatArray) -> FloatArray:
    """|sum of the residual times exp(j omega t)|^2 / n of each channel, shape (k, f)."""
    power = np.zeros((len(series), omegas.size))
    for members in shared_times(series):
        t_s = series[members[0]].t_s
        total = np.zeros((len(members), omegas.size), dtype=np.complex128)
        for part in chunks(t_s.size):
            rest = np.stack([series[k].values[part] for k in members])
            rest -= fit.predict(np.array(members), t_s[part])
            total += rest @ np.exp(1j * np.outer(t_s[part], omegas))
        power[members] = np.abs(total) ** 2 / t_s.size
    return power


def _combinations(count: int, highest: int) -> Iterator[dict[int, int]]:
    """Whole factors of one or two frequencies, of rising order, each tone with one sign."""
    for order in range(1, highest + 1):
        for k in range(count):
            yield {k: order}
        for a, b in combinations(range(count), 2):
            for first in range(1, order):
                yield {a: first, b: order - first}
                yield {a: first, b: first - order}
