"""Values that repeat where the joint must have moved on: frozen, stale and clipped samples.

An exact repeat is cheap to see, and by itself says nothing: a coarse encoder repeats at every
turning point, a joint at rest all the time, and one with stick or play at every reversal of its
command. What makes it an artefact is evidence of motion.
"""

from __future__ import annotations

import numpy as np
from scipy.special import bdtrc

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ...estimators.series import Series
from .result import Span
from .scales import resolution_of, runs, spans_of, turns

FROZEN_TRAVEL = 0.29
"""Travel of the command during a hold, as a share of its range: what it has in a quarter of a
cycle around a turning point, (1 - cos 45 deg)."""

RESOLVED = 4.0
"""So many of the sensor's own steps must be missing."""

STALE_SHARE = 0.4
"""Repeats among fast samples above which values are old: every second sample old is 0.5, an encoder
whose noise is twice its step repeats by chance at 0.14."""

_BY_CHANCE = 0.2
"""Most that fast samples of any encoder repeat by chance."""

_RARE = 1e-7
"""Of all windows of all joints of many sessions, hardly one."""

CLIPPED_SHARE = 0.01
"""Part of the range that is missing above a flat top."""

_REST_TRAVEL = 0.02
"""Travel of the command during a hold at its reversal, as a share of its range, that counts as a
rest of the joint: a sine goes so far in a tenth of its cycle."""

_REST_SHARE = 0.5
"""Part of the reversals at both ends at which a joint with stick or play rests."""

_LIKE_RESTS = 1.5
"""A hold of so many usual rests is no longer one of them."""

_GENTLE = 0.5
"""A joint that comes to rest is slower than this part of its usual fastest steps (95 %)."""

_TURNS = 1.05
"""A motion that goes so many times as far as it gets has turned."""

_CENTRED = 0.42
"""Where a clipped top has the command's extremum, as a share of its duration: in its middle. A
joint that stick or play holds arrives there and stays: W / 4 A of its cycle after the extremum."""

_SAME_RATE = 1e-6
_BOX = 101
_FEW = 24
_ENTRY = 3
_TOPS = 2


def frozen(position: Series, motion: Series, way: Series | None = None) -> tuple[Span, ...]:
    """Return the stretches in which a position stays exactly the same while the joint must move.

    Args:
        motion: What says that it moves: its command, or its velocity integrated over time.
        way: Its velocity integrated over time, if known.

    Returns:
        Holds during which ``motion`` travels by ``FROZEN_TRAVEL`` of its range or more, and the
        joint by ``RESOLVED`` steps of the sensor: if it goes along with ``motion``, and by its
        velocity, unless that stays the same, too. A command may travel far by a tone that the
        joint ignores. Rests at both reversals of the motion, cycle after cycle, are mechanics, and
        so is one at a single reversal that the joint comes to, and leaves, without a jump.
    """
    asked = float(np.ptp(motion.values)) if motion.count else 0.0
    if position.count < 3 or asked == 0:
        return ()
    first, stop = runs(np.diff(position.values) == 0)
    stop = stop + 1  # one past the last of each run of two or more equal values
    travelled = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(motion.values)))))
    begin, end = (np.interp(position.t_s[k], motion.t_s, travelled) for k in (first, stop - 1))
    seen = float(np.ptp(position.values))
    scale = seen / asked if seen > 0 else 1.0
    travel, least = end - begin, RESOLVED * resolution_of(position.values)
    marked = (travel >= FROZEN_TRAVEL * asked) & (scale * np.minimum(travel, asked) > least)
    if np.any(marked):
        marked &= ~_at_reversals(position, motion, first, travel, asked)
        marked &= ~_gentle(position, motion, first, stop)
    spans = _span_each(position.t_s, first[marked], stop[marked])
    return tuple(span for span in spans if way is None or not _stands(way, span, least))


def stale(position: Series) -> tuple[Span, ...]:
    """Return the stretches in which samples repeat old values at new times.

    Looked at where the motion is fast: where the change over four samples is more than half of
    the usual most (95 %), and more than eight times the smallest step that the sensor ever shows.

    Returns:
        Stretches in which more than ``STALE_SHARE`` of the fast samples repeat the one before, and
        so many of them that chance is ruled out (binomial test);
        slow motion between two of them says nothing and belongs to them.
    """
    value = position.values
    if value.size < 16:
        return ()
    repeats = value[2:-2] == value[1:-3]
    if not np.any(_around(repeats) > STALE_SHARE * _FEW):
        return ()
    travel = np.abs(value[4:] - value[:-4])
    fast = travel > max(0.5 * np.percentile(travel, 95), 2 * RESOLVED * resolution_of(value))
    of, among = (_around(samples) for samples in (fast & repeats, fast))
    enough = np.flatnonzero(among >= _FEW)
    if enough.size == 0:
        return ()
    old = of[enough] > STALE_SHARE * among[enough]
    marked = np.zeros(value.size, dtype=np.bool_)
    for k, stop in zip(*runs(old), strict=True):
        seen = slice(max(enough[k] - _BOX // 2, 0), enough[stop - 1] + _BOX // 2 + 1)
        again, quick = int((fast & repeats)[seen].sum()), int(fast[seen].sum())
        # A few of the many windows of a noisy coarse encoder exceed the share by chance.
        if bdtrc(again - 1, quick, _BY_CHANCE) < _RARE:
            marked[enough[k] + 2 : enough[stop - 1] + 3] = True
    return spans_of(position.t_s, marked)


def _at_reversals(
    position: Series, motion: Series, first: IntArray, travel: FloatArray, asked: float
) -> BoolArray:
    """Which holds are rests of a joint with stick or play: usual ones at both reversals."""
    cycles = max(turns(motion).size - 1, 0)
    high = position.values[first] > (position.values.max() + position.values.min()) / 2
    rest = np.zeros(first.size, dtype=np.bool_)
    usual: list[float] = []
    for side in (high, ~high):
        rests = side & (travel > _REST_TRAVEL * asked)
        if cycles < _TOPS or np.count_nonzero(rests) < _REST_SHARE * cycles:
            return rest
        usual.append(float(np.median(np.sort(travel[rests])[-cycles:])))
    for side, most in zip((high, ~high), usual, strict=True):
        rest |= side & (travel <= _LIKE_RESTS * most)
    return rest


def _gentle(position: Series, motion: Series, first: IntArray, stop: IntArray) -> BoolArray:
    """Which holds begin slowly, end without a jump, and have a reversal of the motion inside."""
    value, t_s = position.values, position.t_s
    gentle = np.zeros(first.size, dtype=np.bool_)
    usual = float(np.percentile(np.abs(np.diff(value)), 95))
    for k, (i, j) in enumerate(zip(first.tolist(), stop.tolist(), strict=True)):
        if i < _ENTRY or j > value.size - _ENTRY:
            continue
        came = float(abs(value[i] - value[i - _ENTRY])) / _ENTRY
        jumped = float(abs(value[j] - value[j - 1]))
        inside = motion.at(t_s[i:j])
        net = float(abs(inside[-1] - inside[0]))
        gentle[k] = max(came, jumped) <= _GENTLE * usual and float(np.ptp(inside)) > _TURNS * net
    return gentle


def clipped(
    series: Series, limits: tuple[float, ...] = (), command: Series | None = None
) -> tuple[Span, ...]:
    """Flat tops: the same extreme value again and again, run into at full speed.

    A smooth top of duration T that is entered at slope s is s T / 4 high (a parabola); a flat one
    has lost that height.

    Args:
        limits: Values at which it may stay by itself, e.g. a joint limit or the supply voltage.
        command: Of a driven joint whose position this is.

    Returns:
        The flat tops, if there are two or more at one end of the range that have each lost more
        than ``CLIPPED_SHARE`` of it and twice ``RESOLVED`` steps of the sensor. With a command, its
        own extremum must lie in their middle: a joint that rests after each reversal isn't clipped.
    """
    value, t_s = series.values, series.t_s
    top, bottom = (float(value.max()), float(value.min())) if value.size > 8 else (0.0, 0.0)
    span = top - bottom
    if span == 0:
        return ()
    spans: list[Span] = []
    for level, sign in ((top, 1.0), (bottom, -1.0)):
        if any(abs(level - limit) <= 0.01 * max(abs(limit), span) for limit in limits):
            continue
        i, j = runs(value == level)
        long = (j - i >= _ENTRY) & (i >= _ENTRY) & (j <= value.size - _ENTRY)
        i, j = i[long], j[long]
        if i.size < _TOPS:
            continue
        entered = sign * (level - value[i - _ENTRY]) / (t_s[i] - t_s[i - _ENTRY])
        left = sign * (level - value[j + _ENTRY - 1]) / (t_s[j + _ENTRY - 1] - t_s[j - 1])
        height = np.minimum(entered, left) * (t_s[j - 1] - t_s[i]) / 4
        lost = (height > CLIPPED_SHARE * span) & (height > 2 * RESOLVED * resolution_of(value))
        if command is not None and np.any(lost):
            lost &= _centred(series, command, i, j, sign)
        if np.count_nonzero(lost) >= _TOPS:
            spans += _span_each(t_s, i[lost], j[lost])
    return tuple(sorted(spans))


def _centred(
    series: Series, command: Series, first: IntArray, stop: IntArray, sign: float
) -> BoolArray:
    """Return whether flat tops have their command's extremum in their middle, shape (k,).

    The joint's delay is that of its swings through the middle, over their medians.
    """
    edges, late = turns(command), turns(series)
    if edges.size < _TOPS or late.size < _TOPS:
        return np.ones(first.size, dtype=np.bool_)
    cycle = float(np.median(np.diff(edges)))
    lags = (late - edges[np.clip(np.searchsorted(edges, late) - 1, 0, None)]) % cycle
    delay = float(np.median(lags))
    start_s, stop_s = series.t_s[first], series.t_s[stop - 1]
    marked = np.zeros(first.size, dtype=np.bool_)
    for k, (begin, end) in enumerate(zip(start_s, stop_s, strict=True)):
        reach = max((cycle / 2 - (end - begin)) / 2, 0.0)
        low, up = np.searchsorted(command.t_s, (begin - delay - reach, end - delay + reach))
        near = sign * command.values[low:up]
        if near.size:
            at = np.flatnonzero(near >= near.max() - 1e-9 * np.ptp(command.values))
            extremum = float(command.t_s[low:up][at].mean()) + delay
            marked[k] = extremum - begin > _CENTRED * (end - begin)
    return marked


def _around(marked: BoolArray) -> IntArray:
    """How many are marked in a box around each sample, shape (n,)."""
    half = _BOX // 2
    so_far: IntArray = np.cumsum(marked, dtype=np.int64)
    before: IntArray = np.concatenate((np.zeros(half + 1, dtype=np.int64), so_far))
    return np.concatenate((so_far, np.full(half, so_far[-1])))[half:] - before[: marked.size]


def _stands(way: Series, span: Span, least: float) -> bool:
    """Whether a velocity changes over a stretch, and the joint goes no farther than that."""
    start, stop = np.searchsorted(way.t_s, span)
    inside = way.values[start:stop]
    if inside.size < 3:
        return False
    rates = np.diff(inside) / np.diff(way.t_s[start:stop])
    return bool(np.ptp(inside) < least and np.ptp(rates) > _SAME_RATE * np.abs(rates).max())


def _span_each(t_s: FloatArray, first: IntArray, stop: IntArray) -> tuple[Span, ...]:
    return tuple(zip(t_s[first].tolist(), t_s[stop - 1].tolist(), strict=True))
