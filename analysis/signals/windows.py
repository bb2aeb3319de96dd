"""Which stretch of a session is analysed.

In this order: what the user named; the longest stretch over which the logged gait parameters stay
as they are; after the settling time that the session states; without standing still at the ends.
Within the stretch, energies are taken over whole cycles at its end, where it is best settled.

Where a gait has its steady amplitude: without a soft start and a soft stop.

Controllers let the amplitude of a gait grow over some seconds, and logs that state neither gait nor
settling time hold that, too. A harmonic fit over it leaves what the amplitude lacks as residual,
and its intervals are a hundred times too wide. So the amplitude of the commands is followed, over
one cycle at a time, and what comes before it reaches its steady value is left out. A gait that is
modulated all along, comes in bursts, or changes from one steady amplitude to another has no soft
start, and nothing of it is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import NS, BoolArray, FloatArray, IntArray

from ..estimators.demodulation import starts_of
from ..estimators.harmonic import cos_sin
from ..estimators.series import Series
from ..response.groups import find_groups
from ..response.rhythm import MIN_CYCLES, Rhythm

STEADY = 0.03
"""Cycles whose amplitude is within this share of the commonest one are steady."""

REACHED = 0.005
"""Share of the steady amplitude that may be lacking where the steady part begins; more where the
amplitude itself scatters by more."""

_PARTS = 4
"""Steps of the window of one cycle in each cycle."""

_LEAST_STEADY = 0.9
"""Share of the windows between the first and the last steady one that are steady themselves."""

_LEVEL = 0.3
"""Share of a soft start that no constant amplitude below the steady one may last."""

_AT_FREQUENCY = 0.5
"""Share of a cycle's variance that its frequency explains; a soft start from zero reaches 0.7."""

_SUBHARMONIC = 0.1
"""A fundamental with less than this share of the strongest harmonic's power is a subharmonic."""

_LEAST_SAMPLES = 8

_STEADY = ("A", "omega", "lag", "offset")
"""Logged gait values that must stay; the phase runs on."""

_SAME = 1e-6
"""Relative change of a gait value that counts as none."""

_CYCLE_SLACK = 0.01
"""A stretch this much of a cycle short of a whole number still counts as whole."""


def steady_part(commands: Sequence[Series], start_s: float, stop_s: float) -> tuple[float, float]:
    """Find where the commands have their steady amplitude.

    Args:
        commands: Commands between start and stop.
        start_s: Start of the motion [s].
        stop_s: Its end [s].

    Returns:
        Start and end of the steady part [s]; those of the motion where it has no soft start or no
        soft stop, or where less than ``MIN_CYCLES`` steady cycles would be left.
    """
    groups = find_groups(commands, stop_s - start_s)
    if groups is None:
        return start_s, stop_s
    first_s, last_s = start_s, stop_s
    slowest_s = 0.0
    for rhythm in groups.rhythms:
        members = [command for command in commands if command.name in rhythm.names]
        omega = rhythm.omega * _strongest(rhythm)
        period_s = 2 * np.pi / omega
        slowest_s = max(slowest_s, period_s)
        if (stop_s - start_s) / period_s > sum(member.t_s.size for member in members):
            continue  # most of these cycles have no sample: there is no soft start to be seen
        edges_s = np.arange(start_s, stop_s + 1e-6 * period_s, period_s / _PARTS)
        lead, tail = soft_ends(amplitude_by_cycle(members, omega, edges_s))
        if lead:
            first_s = max(first_s, float(edges_s[lead]))
        if tail:
            last_s = min(last_s, float(edges_s[edges_s.size - 1 - tail]))
    return (start_s, stop_s) if last_s - first_s < MIN_CYCLES * slowest_s else (first_s, last_s)


def _strongest(rhythm: Rhythm) -> int:
    """Order of the harmonic to follow: over a long soft start a subharmonic may fit best."""
    power = np.sum(np.abs(rhythm.fit.amplitudes) ** 2, axis=0)
    order = int(np.argmax(power))
    return order + 1 if power[0] < _SUBHARMONIC * power[order] else 1


def amplitude_by_cycle(commands: Sequence[Series], omega: float, edges_s: FloatArray) -> FloatArray:
    """Follow the amplitude of several commands together.

    Args:
        commands: Commands, k of them.
        omega: Their angular frequency [rad/s].
        edges_s: Times a quarter of a cycle apart [s], shape (n,).

    Returns:
        Root of the summed squares of the amplitudes, over one cycle from each edge on, by least
        squares with a constant, shape (n - 4,); NaN where a cycle has too few samples or most of
        its motion is not at that frequency.
    """
    count = max(edges_s.size - _PARTS, 0)
    power, motion = np.zeros((2, count))
    for command in commands:
        starts = starts_of(command.t_s, edges_s)
        begin, end = starts[:count], starts[_PARTS : _PARTS + count]
        cosine, sine = cos_sin(omega * command.t_s)
        rows = np.stack([np.ones(command.count), cosine, -sine])
        values = command.values - command.values.mean()
        usable: BoolArray = end - begin >= _LEAST_SAMPLES
        gram = np.stack([_sums(rows * row, begin, end) for row in rows], axis=1)[usable]
        solved = np.linalg.solve(gram, _sums(rows * values, begin, end)[usable][..., None])[..., 0]
        power[usable] += solved[:, 1] ** 2 + solved[:, 2] ** 2
        power[~usable] = np.nan
        filled = np.maximum(end - begin, 1)
        mean, square = _sums(np.stack([values, values**2]), begin, end).T / filled
        motion += 2 * (square - mean**2)
    other = (power < _AT_FREQUENCY * motion) & (motion > STEADY**2 * motion.max(initial=0.0))
    return np.sqrt(np.where(other, np.nan, power))


def _sums(rows: FloatArray, begin: IntArray, end: IntArray) -> FloatArray:
    """Return the sums of the rows (q, n) from begin to end, each of shape (c,); shape (c, q)."""
    running = np.zeros((rows.shape[0], rows.shape[1] + 1))
    np.cumsum(rows, axis=1, out=running[:, 1:])
    return (running[:, end] - running[:, begin]).T


def soft_ends(size: FloatArray) -> tuple[int, int]:
    """Find a soft start and a soft stop in an amplitude that was followed by cycles.

    Args:
        size: Amplitude of each window, a quarter of a cycle apart, shape (n,); NaN is not steady.

    Returns:
        How many quarters of a cycle to leave out at the start and at the end; 0 where the
        amplitude begins, or ends, steady, and where it varies otherwise than by a soft start.
    """
    followed = np.isfinite(size) & (size > 0)
    if np.count_nonzero(followed) < _PARTS * MIN_CYCLES:
        return 0, 0
    level = _commonest(size[followed])
    steady = followed & (np.abs(np.where(followed, size, 0.0) / level - 1) <= STEADY)
    inside = np.flatnonzero(steady)
    first, last = int(inside[0]), int(inside[-1])
    if last - first < _PARTS * (MIN_CYCLES - 1) or steady[first : last + 1].mean() < _LEAST_STEADY:
        return 0, 0
    plateau = size[steady]
    level = float(np.median(plateau))
    scatter = 1.4826 * float(np.median(np.abs(plateau - level))) / level
    lacking = level * (1 - min(max(REACHED, 3 * scatter), STEADY))
    end = size.size - 1 - last
    return _lead(size, first, level, lacking), _lead(size[::-1], end, level, lacking)


def _commonest(size: FloatArray) -> float:
    """Return the median of the largest number of values within ``STEADY`` of one of them."""
    ordered = np.sort(size)
    stops = np.searchsorted(ordered, ordered * (1 + 2 * STEADY), side="right")
    k = int(np.argmax(stops - np.arange(ordered.size)))
    return float(np.median(ordered[k : stops[k]]))


def _lead(size: FloatArray, first: int, level: float, lacking: float) -> int:
    """Windows to leave out before the steady part; 0 where what comes before is no soft start."""
    reached = first + int(np.argmax(size[first:] >= lacking))
    if reached == 0:
        return 0
    lead = size[:first]
    if lead.size and not np.all(np.isfinite(lead)):
        return 0
    falls = np.maximum.accumulate(lead) - lead
    if lead.size and (float(falls.max()) > STEADY * level or float(lead.max()) > level):
        return 0
    if lead.size >= _PARTS * MIN_CYCLES:
        # A constant amplitude below the steady one is another gait, not a start.
        stops = np.searchsorted(np.sort(lead), np.sort(lead) * (1 + 2 * STEADY), side="right")
        longest = int(np.max(stops - np.arange(lead.size)))
        if longest >= max(_PARTS * MIN_CYCLES, _LEVEL * lead.size):
            return 0
    return reached + 1


@dataclass(frozen=True)
class Span:
    """The window over which energies are taken, in s from the common origin.

    Attributes:
        origin_ns: Unix time of the origin [ns].
        start_s: Start [s].
        stop_s: End, not included [s].
        cycles: Whole cycles in it; 0 where there is no gait.
    """

    origin_ns: int
    start_s: float
    stop_s: float
    cycles: int


@dataclass(frozen=True)
class Stretch:
    """A half-open stretch of the session.

    Attributes:
        start_ns: Unix time [ns].
        stop_ns: Unix time, not included [ns].
    """

    start_ns: int
    stop_ns: int

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (self.stop_ns - self.start_ns) / NS

    def since(self, origin_ns: int) -> tuple[float, float]:
        """Return start and stop from an origin [Unix ns], in seconds."""
        return (self.start_ns - origin_ns) / NS, (self.stop_ns - origin_ns) / NS

    def intersect(self, start_ns: int | None, stop_ns: int | None) -> Stretch:
        """Return the part of it within limits.

        Args:
            start_ns: Lower limit [Unix ns], or None.
            stop_ns: Upper limit [Unix ns], or None.

        Returns:
            The part; of no length where there is none.
        """
        start = self.start_ns if start_ns is None else max(self.start_ns, start_ns)
        stop = self.stop_ns if stop_ns is None else min(self.stop_ns, stop_ns)
        return Stretch(start, max(start, stop))


def covered(times_ns: Sequence[IntArray]) -> Stretch | None:
    """From the first to just after the last sample of any channel.

    Args:
        times_ns: Sampling times of the channels [Unix ns], in order.

    Returns:
        The stretch, the last sample's own interval included; None without samples.
    """
    filled = [t for t in times_ns if t.size]
    if not filled:
        return None
    last = max(filled, key=lambda t: int(t[-1]))
    interval = int(np.median(np.diff(last))) if last.size > 1 else 1
    return Stretch(min(int(t[0]) for t in filled), int(last[-1]) + max(interval, 1))


def steady_runs(
    t_ns: IntArray,
    names: Sequence[str],
    values: FloatArray,
    ignore: Sequence[str] = (),
    *,
    least_s: float = 0.0,
) -> list[Stretch]:
    """Return the stretches over which the logged gait parameters stay as they are.

    Args:
        t_ns: Times of the gait samples [Unix ns], shape (n,).
        names: Names such as ``horizontal.A``, shape (k,).
        values: Shape (n, k).
        ignore: Values that may change, e.g. ``offset``.
        least_s: Shorter runs are left out [s]; an adaptive gait has one for each sample.

    Returns:
        Runs in order of time; each ends with the first sample that differs, the last one an
        interval after the last sample.
    """
    if t_ns.size == 0:
        return []
    kept = [k for k, name in enumerate(names) if name.rpartition(".")[2] in _STEADY]
    kept = [k for k in kept if names[k].rpartition(".")[2] not in ignore]
    changed: BoolArray = np.zeros(t_ns.size - 1, dtype=np.bool_)
    for steady in values.T[kept]:
        step = np.abs(np.diff(steady))
        if np.any(step):
            size = np.abs(steady)
            changed |= step > _SAME * np.maximum(size[1:], size[:-1]) + 1e-12
    edges = np.concatenate([[0], np.flatnonzero(changed) + 1, [t_ns.size]])
    interval = int(np.median(np.diff(t_ns))) if t_ns.size > 1 else 1
    starts, stops = t_ns[edges[:-1]], np.append(t_ns, t_ns[-1] + interval)[edges[1:]]
    kept_runs = stops - starts >= least_s * NS
    pairs = zip(starts[kept_runs].tolist(), stops[kept_runs].tolist(), strict=True)
    return [Stretch(start, stop) for start, stop in pairs]


def settled(run: Stretch, session_start_ns: int, settle_s: float) -> Stretch:
    """A run without its settling time.

    The settling time counts from the session's start, so that a ramp at the start is part of it;
    for a run that begins later it counts from the run's own start.

    Args:
        session_start_ns: Unix time [ns].
        settle_s: Settling time [s].

    Returns:
        What is left of it.
    """
    settle_ns = round(settle_s * NS)
    first = session_start_ns + settle_ns
    start = max(run.start_ns, first) if run.start_ns < first else run.start_ns + settle_ns
    return run.intersect(start, None)


def moving(commands: Sequence[Series]) -> tuple[float, float] | None:
    """From the first to the last sample at which any command moves.

    Returns:
        Times [s], or None where no command ever moves.
    """
    changes = [(command.t_s, np.flatnonzero(np.diff(command.values) != 0)) for command in commands]
    spans = [(float(t_s[k[0]]), float(t_s[k[-1] + 1])) for t_s, k in changes if k.size]
    return (min(spans)[0], max(stop for _, stop in spans)) if spans else None


def whole_cycles(start_s: float, stop_s: float, frequency_hz: float) -> tuple[float, float, int]:
    """Return the whole cycles at the end of a stretch.

    Args:
        start_s: Start of the stretch [s].
        stop_s: Its end [s].
        frequency_hz: Gait frequency [Hz].

    Returns:
        Start and end [s], and the number of cycles; none of them where it is shorter than one.
    """
    cycles = math.floor((stop_s - start_s) * frequency_hz + _CYCLE_SLACK)
    span_s = cycles / frequency_hz
    if (stop_s - start_s - span_s) * frequency_hz <= _CYCLE_SLACK:  # the stretch is whole cycles
        return start_s, min(start_s + span_s, stop_s), cycles
    return stop_s - span_s, stop_s, cycles


def long_enough(duration_s: float, frequency_hz: float) -> bool:
    """Return whether a stretch holds enough cycles for an analysis.

    Args:
        duration_s: Its length [s].
        frequency_hz: Gait frequency [Hz].

    Returns:
        True for ``MIN_CYCLES`` or more.
    """
    return duration_s * frequency_hz >= MIN_CYCLES - _CYCLE_SLACK
