"""The signals of one joint, and its response to the command cycle by cycle.

At one frequency a sound joint has one gain and one lag, and what departs from them is a fault. A
chirp, a multisine or noise has no such frequency: gain and lag of a sound joint change all the
time. There a finite impulse response is fitted,

    y(t) = sum_i h_i c(t - i D) + offset,

and its output stands in for the command: a sound joint follows that with gain 1 and without lag. A
joint that it doesn't explain is judged by its command as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from ..common.arrays import BoolArray, ComplexArray, FloatArray, merged_ranges
from .fault import Span

BLOCKS = 4
"""Blocks a cycle: windows of one cycle start at every quarter of it."""

FEW_SAMPLES = 8  # a window with fewer samples is not judged
FULL_SHARE = 0.6  # a window with less than this share of its usual samples is not judged
QUIET = 0.25  # a window whose command moves less than this share of its usual range is not judged
RIDGE = 1e-6  # relative ridge on the normal equations: a ramp and its delayed copy are collinear


@dataclass(frozen=True)
class Samples:
    """One quantity of one joint: finite samples at increasing times.

    Attributes:
        t_s: Times from the common origin [s], strictly increasing, shape (n,).
        values: Shape (n,).
    """

    t_s: FloatArray
    values: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return values at other times, interpolated linearly; the ends are held."""
        if t_s is self.t_s:
            return self.values
        return np.interp(t_s, self.t_s, self.values).astype(np.float64, copy=False)

    @property
    def range(self) -> float:
        """Largest minus smallest value."""
        return float(np.ptp(self.values)) if self.values.size else 0.0

    @cached_property
    def period_s(self) -> float:
        """Median sampling interval [s]."""
        return median_of(np.diff(self.t_s))


@dataclass(frozen=True)
class JointMotion:
    """What was recorded of one joint; None for a quantity that was not.

    Attributes:
        command: Commanded position [rad].
        position: Measured position [rad].
        velocity: [rad/s].
        effort: Torque [N m], or motor current [A] where no torque was recorded.
        reference: Position by a second sensor [rad].
        limits: Lower and upper limit of the joint [rad], or None.
    """

    name: str
    command: Samples
    position: Samples
    velocity: Samples | None = None
    effort: Samples | None = None
    reference: Samples | None = None
    limits: tuple[float, float] | None = None

    @cached_property
    def response(self) -> Response:
        """Its position's response to its command, cycle by cycle; each has two samples or more."""
        return windowed_response(self.command, self.position, cycle_s(self.command))

    @cached_property
    def largest_step(self) -> float:
        """The most that the command moves from one sample of the position to the next [rad]."""
        asked = self.command.at(self.position.t_s)
        return float(np.abs(np.diff(asked)).max()) if asked.size > 1 else 0.0


def cycle_s(command: Samples) -> float:
    """Return median length of the command's cycles.

    Returns:
        Time from one upward crossing of its middle to the next, with hysteresis [s]; a tenth of
        the record where there are fewer than three crossings.
    """
    middle = (float(command.values.max()) + float(command.values.min())) / 2
    far = np.abs(command.values - middle) > 0.2 * command.range
    high = command.values[far] > middle
    times = command.t_s[far][1:][high[1:] & ~high[:-1]]
    if times.size < 3:
        return float(command.t_s[-1] - command.t_s[0]) / 10
    return float(np.median(np.diff(times)))


@dataclass(frozen=True)
class Response:
    """Least squares of a position on its command, over windows of one cycle.

    In each window the position is ``o + a c(t) + b c(t - T/4)``; for a sine of period T the
    response is H = a - j b.

    Attributes:
        start_s: Start of each window [s], shape (w,).
        stop_s: Its end [s], shape (w,).
        valid: Windows with enough samples and a command that moves, shape (w,).
        ratio: H, shape (w,).
        offset: o minus what the mean command explains by H, i.e. the mean of the position less
            that of the command [rad], shape (w,).
        explained: Share of the position's variance that is explained, 0 to 1, shape (w,).
        spread: Standard deviation of the position [rad], shape (w,).
        asked: Standard deviation of the command [rad], shape (w,).
        period_s: T [s].
    """

    start_s: FloatArray
    stop_s: FloatArray
    valid: BoolArray
    ratio: ComplexArray
    offset: FloatArray
    explained: FloatArray
    spread: FloatArray
    asked: FloatArray
    period_s: float


def windowed_response(command: Samples, position: Samples, period_s: float) -> Response:
    """Fit the response in every window of one cycle, a quarter of a cycle apart.

    Args:
        command: The command [rad].
        position: The measured position [rad].
        period_s: Cycle of the command T [s].

    Returns:
        The response; no windows where the record is shorter than one cycle.
    """
    start = max(command.t_s[0], position.t_s[0])
    stop = min(command.t_s[-1], position.t_s[-1])
    block = period_s / BLOCKS
    count = int((stop - start) / block + 1e-9) if block > 0 else 0
    if count > BLOCKS * position.t_s.size:  # hardly any window has a sample
        count = 0
    windows = max(count - BLOCKS + 1, 0)
    i, j = np.searchsorted(position.t_s, (start, start + count * block))
    t_s, p = position.t_s[i:j], position.values[i:j]
    c, d = command.at(t_s), command.at(t_s - period_s / BLOCKS)
    middle, level = median_of(p, 0.0), median_of(c, 0.0)
    rows = np.stack([np.ones_like(c), c - level, d - level, p - middle])
    # Sums over each block, then over the blocks of each window.
    edges: FloatArray = start + block * np.arange(count + 1, dtype=np.float64)
    first = np.searchsorted(t_s, edges)
    moments = np.zeros((windows, 4, 4))
    for row in range(4):
        for column in range(row, 4):
            total = np.concatenate(([0.0], np.cumsum(rows[row] * rows[column])))[first]
            moments[:, row, column] = total[BLOCKS:][:windows] - total[:-BLOCKS][:windows]
            moments[:, column, row] = moments[:, row, column]
    return _solved(moments, start, block, period_s, middle - level)


def _solved(
    moments: FloatArray, start: float, block: float, period_s: float, shift: float
) -> Response:
    """Solve the normal equations of each window."""
    count = np.maximum(moments[:, 0, 0], 1.0)
    mean = moments[:, 0, 1:] / count[:, None]
    centred = moments[:, 1:, 1:] - count[:, None, None] * mean[:, :, None] * mean[:, None, :]
    asked = np.sqrt(np.maximum(centred[:, 0, 0] / count, 0.0))
    spread = np.sqrt(np.maximum(centred[:, 2, 2] / count, 0.0))
    usual = median_of(moments[:, 0, 0], 0.0)
    valid = (moments[:, 0, 0] >= FEW_SAMPLES) & (moments[:, 0, 0] >= FULL_SHARE * usual)
    lively = np.percentile(asked[valid], 75) if valid.any() else 0.0
    valid &= (asked >= QUIET * lively) & (asked > 0)
    gram = centred[:, :2, :2] + RIDGE * np.trace(centred[:, :2, :2], axis1=1, axis2=2)[
        :, None, None
    ] * np.eye(2)
    gram[~valid] = np.eye(2)
    target = centred[:, :2, 2]
    # Two unknowns in closed form (Cramer's rule).
    (aa, ab), (_, bb) = gram[:, 0].T, gram[:, 1].T
    determinant = aa * bb - ab**2
    first = (bb * target[:, 0] - ab * target[:, 1]) / determinant
    second = (aa * target[:, 1] - ab * target[:, 0]) / determinant
    power = centred[:, 2, 2]
    explained = np.divide(
        first * target[:, 0] + second * target[:, 1],
        power,
        out=np.zeros_like(power),
        where=power > 0,
    )
    starts = start + block * np.arange(len(moments), dtype=np.float64)
    return Response(
        start_s=starts,
        stop_s=starts + BLOCKS * block,
        valid=valid,
        ratio=np.asarray(first - 1j * second, dtype=np.complex128),
        offset=mean[:, 2] - mean[:, 0] + shift,
        explained=np.clip(explained, 0.0, 1.0),
        spread=spread,
        asked=asked,
        period_s=period_s,
    )


def predicted(
    motion: JointMotion, period_s: float, ratio: complex, offset: float, t_s: FloatArray
) -> FloatArray:
    """Return the position that a response would give.

    Args:
        period_s: Cycle of its command T [s].
        ratio: H.
        offset: Mean of the position less that of the command [rad].
        t_s: Times [s], shape (n,).

    Returns:
        Positions [rad], shape (n,).
    """
    c, d = motion.command.at(t_s), motion.command.at(t_s - period_s / BLOCKS)
    level = float(np.mean(c)) if c.size else 0.0
    return level + offset + ratio.real * (c - level) - ratio.imag * (d - level)


def within(t_s: FloatArray, spans: tuple[Span, ...]) -> BoolArray:
    """Mark the times, increasing, that lie in any span, and the first one after each span."""
    marked = np.zeros(t_s.size, dtype=np.bool_)
    for start, stop in spans:
        i, j = np.searchsorted(t_s, (start, stop))
        marked[i : j + 1] = True
    return marked


def record_span(motion: JointMotion) -> Span:
    """Return the first and last time of a joint's positions, or else of its commands [s]."""
    t_s = motion.position.t_s if motion.position.t_s.size else motion.command.t_s
    return (float(t_s[0]), float(t_s[-1])) if t_s.size else (0.0, 0.0)


COHERENT = 0.5
"""Explained share above which a window follows its command, with whatever gain and lag."""

NO_RESPONSE = 0.2  # gain, as a share of the common one, below which a window shows no response
STILL = 0.3  # motion, as a share of the usual one, below which a joint stands still
# Phase against the common response beyond which a joint moves the opposite way.
OPPOSITE_RAD = np.radians(150.0)
DEGREE = float(np.degrees(1.0))

# Factor within which a gain of 180/pi is a matter of units: a weak servo's gain is in it.
UNIT_SLACK = 1.6
NEIGHBOURS = 4  # joints that one joint is compared with: the nearest ones
MIN_WINDOWS = 5  # windows (two whole cycles) that a joint's own usual response needs
LOADED = 0.7  # gain below which a joint's neighbours are held back by a load: then it may be, too
# A joint whose windows follow less than this share of the time has no usual response.
MIN_SHARE = 0.5

_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Judged:
    """One joint's windows, judged.

    Attributes:
        motion: The joint's signals.
        response: Its response in each window.
        follows: Windows that follow the command, shape (w,).
        still: Windows in which the joint stands still, shape (w,).
        opposite: Windows in which it moves the opposite way, shape (w,).
        ratio: Its usual H; the common one where it has none of its own.
        offset: Its usual offset [rad].
        common: The response that its neighbours have in common.
    """

    motion: JointMotion
    response: Response
    follows: BoolArray
    still: BoolArray
    opposite: BoolArray
    ratio: complex
    offset: float
    common: complex

    @property
    def loaded(self) -> bool:
        """Whether its neighbours are held back by a load: then it may be, too."""
        return abs(self.common) < LOADED

    @property
    def has_usual(self) -> bool:
        """Whether the joint has a usual response of its own."""
        return int(np.count_nonzero(self.follows)) >= MIN_WINDOWS


def own_response(response: Response) -> complex | None:
    """Return the usual response of one joint.

    Returns:
        Median of H over the windows that it explains; None where it explains too few, which is
        no response.
    """
    coherent = response.valid & (response.explained > COHERENT) & (np.abs(response.ratio) > 1e-3)
    if np.count_nonzero(coherent) < max(1, 0.2 * np.count_nonzero(response.valid)):
        return None
    return complex_median(response.ratio[coherent])


def neighbours(values: Sequence[_Value], k: int) -> list[_Value]:
    """Return the values of the ``NEIGHBOURS`` joints nearest to a joint, without its own.

    The gain of a loaded chain changes along the body.
    """
    others = sorted((j for j in range(len(values)) if j != k), key=lambda j: (abs(j - k), j))
    return [values[j] for j in others[:NEIGHBOURS]]


def common_response(own: Sequence[complex | None]) -> complex:
    """Return the response that some joints have in common.

    Args:
        own: Response of each; None for none.

    Returns:
        Median gain at the circular median lag of the joints that respond, with one vote for an
        ideal response, so that two joints of opposite sign are separated.
    """
    values = np.asarray([1.0 + 0.0j, *(each for each in own if each is not None)])
    unit = values / np.abs(values)
    # The circular median: the phase of the joint that is nearest to all others.
    distance = np.abs(np.angle(unit[:, None] * unit.conj()[None, :])).sum(axis=1)
    return complex(median_of(np.abs(values[1:]), 1.0) * unit[int(np.argmin(distance))])


def judge(motion: JointMotion, response: Response, common: complex) -> Judged:
    """Judge each window of one joint.

    Args:
        common: The response that its neighbours have in common.
    """
    relative = response.ratio / common
    coherent = response.explained > COHERENT
    moves = response.spread > STILL * abs(common) * response.asked
    opposite = response.valid & coherent & moves & (np.abs(np.angle(relative)) > OPPOSITE_RAD)
    opposite &= np.abs(relative) < UNIT_SLACK**2
    responds = coherent & (np.abs(relative) > NO_RESPONSE)
    units = (response.explained > 0.9) & (
        np.abs(np.log(np.maximum(np.abs(relative), 1e-12) * DEGREE)) < np.log(UNIT_SLACK)
    )
    follows = response.valid & (responds | units) & ~opposite
    still = response.valid & ~follows & ~opposite & ~moves
    chosen = follows if follows.any() else opposite
    ratio = complex_median(response.ratio[chosen]) if chosen.any() else common
    offset = median_of(response.offset[chosen if chosen.any() else response.valid], 0.0)
    return Judged(motion, response, follows, still, opposite, ratio, offset, common)


def marked_spans(response: Response, marked: BoolArray) -> tuple[Span, ...]:
    """Return marked windows as time spans [s], overlapping ones joined."""
    windows = zip(response.start_s[marked].tolist(), response.stop_s[marked].tolist(), strict=True)
    return tuple(merged_ranges(windows, 0.0))


def whole_or(spans: tuple[Span, ...], response: Response) -> tuple[Span, ...]:
    """Return the spans, or none if one covers nearly all windows, i.e. a permanent fault."""
    if len(spans) == 1 and response.start_s.size:
        cycle = response.period_s
        begin, end = response.start_s[0], response.stop_s[-1]
        if spans[0][0] - begin < cycle and end - spans[0][1] < cycle:
            return ()
    return spans


def complex_median(values: ComplexArray) -> complex:
    """Return the median of the real and of the imaginary parts, of at least one value."""
    return complex(np.median(values.real), np.median(values.imag))


def median_of(values: FloatArray, default: float = float("nan")) -> float:
    """Return the median, or the default without values."""
    return float(np.median(values)) if values.size else default


def robust_deviation(values: FloatArray, centre: float) -> float:
    """Return the standard deviation of normal values by their median distance from the centre."""
    return 1.4826 * float(np.median(np.abs(values - centre)))


def runs_of(marked: BoolArray) -> list[list[int]]:
    """Return the first index and the one after the last of each run of marks."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], marked, [False])).astype(np.int8)))
    return edges.reshape(-1, 2).tolist()


SWEPT = 2.0
"""Ratio of long to short cycles, as 90 % and 10 % quantiles, of a command that is no rhythm."""

CYCLES = 8  # of the command, that show it
TAPS = 40
MEMORY_S = 0.8  # that the taps span at least, and two thirds of a cycle
EXPLAINED = 0.8  # share of the position's variance that makes it the joint's response
_SLOWEST = 0.005  # share of the command's power that is slower
_OPPOSITE = 0.5  # cosine: within 60 degrees of half a turn
_ROWS = 20_000  # that the fit takes


def linearised(motion: JointMotion) -> JointMotion:
    """Return a joint whose command, if it is no rhythm, is replaced by its linear response.

    A response opposite to slow commands is turned round, so that the joint moves against it.
    """
    command, position = motion.command, motion.position
    if position.t_s.size < 4 * TAPS or _is_rhythm(command):
        return motion
    step = max(max(MEMORY_S, cycle_s(command) * 2 / 3) / TAPS, position.period_s)
    rows = slice(None, None, -(-position.t_s.size // _ROWS))
    late = [_late(command, position.t_s[rows], k, step) for k in range(TAPS)]
    design = np.stack([*late, np.ones(late[0].size)], axis=1)
    found = np.linalg.lstsq(design, position.values[rows], rcond=1e-9)[0]
    taps = np.asarray(found, dtype=np.float64)
    response = np.full(position.t_s.size, taps[-1])
    for k, tap in enumerate(taps[:-1].tolist()):  # one at a time: a long record fills the memory
        response += tap * _late(command, position.t_s, k, step)
    left = float(np.var(position.values - response))
    if left > (1 - EXPLAINED) * float(np.var(position.values)):
        return motion
    if _turned_round(command, taps[:-1], step):
        response = 2 * response.mean() - response
    return replace(motion, command=Samples(position.t_s, response))


def _turned_round(command: Samples, taps: FloatArray, step_s: float) -> bool:
    """Return whether the response is opposite where the command is slowest.

    At rest a sound joint has a positive gain, but a command without a mean doesn't show it.
    """
    values = command.values - command.values.mean()
    power: FloatArray = np.abs(np.fft.rfft(values * np.hanning(values.size))) ** 2
    slow = int(np.count_nonzero(np.cumsum(power) < _SLOWEST * float(power.sum())))
    turn = 2 * np.pi * slow / (command.t_s[-1] - command.t_s[0]) * step_s
    phase = turn * np.arange(taps.size)
    real, imaginary = float(taps @ np.cos(phase)), float(taps @ np.sin(phase))
    return real < -_OPPOSITE * float(np.hypot(real, imaginary))


def _late(command: Samples, t_s: FloatArray, k: int, step_s: float) -> FloatArray:
    """Return c(t - k D), shape (n,)."""
    return command.at(t_s - k * step_s)


def _is_rhythm(command: Samples) -> bool:
    """Return whether cycles, from one rise through the middle to the next, are alike or too few."""
    above = command.values > np.median(command.values)
    rises = command.t_s[1:][above[1:] & ~above[:-1]]
    if rises.size <= CYCLES:
        return True
    short, long = np.percentile(np.diff(rises), (10, 90))
    return bool(long <= SWEPT * short)
