"""Name what is wrong with the episodes of a data set.

An episode is compared with the others of its data set: each joint's gain, lag and offset, the lag
that its joints have in common, lost frames, and signals that stand. Each is at a level over all
episodes and joints, with the scatter that the sound episodes have, and is named only from a size
on that matters. Of an episode whose frames were lost nothing else is named: its record has several
times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import ANGLE_MARGIN_RAD, HALF, QUARTER, TINY, WIDTH

from .deviations import Deviations, refined
from .jumps import Jumps
from .outliers import Outliers, median_of, outliers_of, scatter_of
from .pace import pace_of
from .record import Record, block_of
from .response import Response
from .result import EpisodeFault

LEVEL = 0.02
"""Chance that anything is named in a sound data set."""

FAMILIES = 8
"""Of questions: gain, lag, offset, the lag in common, lost frames, doubled ones, states that stand,
commands that stand."""

LIKELY = 0.05
"""Level from which a joint is looked at again, frame by frame."""

GAIN_MATTERS = 0.05
"""Of a gain: what people who teach vary by is more."""

LAG_MATTERS = HALF
"""Of a lag [frames]: a policy sees whole ones."""

RATE_MATTERS = 0.03
"""Of a rate."""

SCALED = 2.0
"""From this factor on a gain isn't a weak joint's, but a signal's that was scaled."""

SEARCHED_S = 0.35
"""Lags on either side of the common one that are searched [s]."""

WORSE = float(np.log(2.0))
"""What is left is this much more (of its logarithm) where an episode is looked at again."""

PER_MEDIAN = 1.2533
"""Standard error of a median over that of a mean, of normal values: root of pi / 2."""


@dataclass(frozen=True)
class Measured:
    """All that is measured of e episodes and m joints.

    Attributes:
        used: Indices of the episodes that are compared, shape (u,); all arrays are of these.
        inflation: Of the variances of level, gain and lag, shape (3, m).
        frozen: Motion of the command while the state stands, shape (u, m).
        unasked: Motion of the state while the command stands, shape (u, m).
    """

    record: Record
    used: IntArray
    response: Response
    deviations: Deviations
    inflation: FloatArray
    jumps: Jumps
    frozen: FloatArray
    unasked: FloatArray


def faults_of(measured: Measured, unit: str, margin: float) -> list[EpisodeFault]:
    """Return what is wrong, worst first.

    Args:
        unit: Of the states.
        margin: An offset that matters, in it.
    """
    _search_again(measured)
    judge = _Judge(measured, unit, margin)
    faults = [*judge.jumps(), *judge.standing()]
    skipped = {fault.episode for fault in faults if fault.joint is None}
    named = {(fault.episode, fault.joint) for fault in faults}
    for fault in judge.shared(skipped):
        faults.append(fault)
    faults += [
        fault
        for fault in judge.joints(skipped)
        if (fault.episode, fault.joint) not in named
    ]
    return sorted(faults, key=lambda fault: (-fault.times, fault.episode))


def values_of(measured: Measured) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return gain (a factor less 1), lag [frames] and offset of each joint, and their errors."""
    d = measured.deviations
    usual = median_of(d.gain)
    usual = np.where(np.abs(usual) > TINY, usual, 1.0)
    noise = np.sqrt(median_of(d.left) * measured.inflation)  # level, gain, lag
    values = {
        "gain": d.gain / usual - 1,
        "lag": d.lag,
        "offset": d.mean - usual * d.middle,
    }
    errors = {
        "gain": d.gain_unit * noise[1] / np.abs(usual),
        "lag": d.lag_unit * noise[2] / np.abs(usual),
        "offset": noise[0] / np.sqrt(d.count),
    }
    return values, errors


def _search_again(measured: Measured) -> None:
    """Search the lags of the episodes in which a joint may be off further than a line tells."""
    values, errors = values_of(measured)
    left = np.log(measured.deviations.left + TINY)
    likely = outliers_of(left, np.zeros_like(left), WORSE, LIKELY).outside
    for quantity, margin in (("gain", GAIN_MATTERS), ("lag", LAG_MATTERS)):
        likely |= outliers_of(values[quantity], errors[quantity], margin, LIKELY).outside
    again = np.flatnonzero(likely.any(axis=1))
    if again.size:
        most = max(int(np.ceil(SEARCHED_S * measured.record.fps)), 1)
        search = replace(measured.record)
        for index in again.tolist():
            refined(
                search, measured.response, measured.deviations,
                np.array([index]), measured.used[[index]], most,
            )  # fmt: skip


class _Judge:
    """The questions, in their order."""

    def __init__(self, measured: Measured, unit: str, margin: float) -> None:
        self._m, self._unit, self._margin = measured, unit, margin
        self._values, self._errors = values_of(measured)
        self._level = LEVEL / FAMILIES

    def _number(self, index: int) -> int:
        return int(self._m.record.numbers[self._m.used[index]])

    def jumps(self) -> Iterator[EpisodeFault]:
        """Yield episodes with frames that were lost, or that are there twice."""
        jumps, fps = self._m.jumps, self._m.record.fps
        windows = max(float(np.sum(self._m.record.lengths)), 1.0)
        least = float(ndtri(1 - self._level / windows))
        for values, lost in ((jumps.lost, True), (jumps.twice, False)):
            outliers = self._largest(values[:, None], least)
            for index in np.flatnonzero(outliers.outside[:, 0] & (values > least)).tolist():
                after = int((jumps.after if lost else jumps.twice_after)[index])
                if lost and not jumps.lost[index] >= jumps.twice[index] * HALF:
                    continue
                if not lost and not self._is_copy(index, after):
                    continue
                times = float(values[index] / max(float(outliers.half[index, 0]), least))
                yield self._jump(index, after, times, fps, lost=lost)

    def _jump(
        self, index: int, after: int, times: float, fps: float, *, lost: bool
    ) -> EpisodeFault:
        number, at_s = self._number(index), after / fps
        if not lost:
            return EpisodeFault(
                number, "doubled", None, 1.0, "frames", None, times, at_s,
                f"a frame is there twice at {at_s:.2f} s",
            )  # fmt: skip
        jumps = self._m.jumps
        time, half = float(jumps.time[index]), WIDTH * float(jumps.error[index])
        count = max(round(time), 1)
        return EpisodeFault(
            number, "dropped", None, float(count), "frames", (time - half, time + half), times,
            at_s, f"all joints jump at {at_s:.2f} s as if {count} frame{'s' * (count > 1)} "
            "were missing",
        )  # fmt: skip

    def _is_copy(self, index: int, after: int) -> bool:
        """Return whether a frame has the same states as the one before."""
        row = int(self._m.record.starts[self._m.used[index]]) + after
        rows = self._m.record.states[row - 1 : row + 1]
        return bool(np.array_equal(rows[0], rows[1]))

    def standing(self) -> Iterator[EpisodeFault]:
        """Yield joints whose states or commands stand while the others move."""
        for values, signal, other in (
            (self._m.frozen, "state", "command"), (self._m.unasked, "command", "state"),
        ):  # fmt: skip
            outliers = self._largest(values, self._margin)
            for index in np.flatnonzero(outliers.outside.any(axis=1)).tolist():
                joints = np.flatnonzero(outliers.outside[index] & (outliers.deviation[index] > 0))
                if joints.size:
                    yield from self._stands(index, joints, values, outliers, signal, other)

    def _stands(
        self, index: int, joints: IntArray, values: FloatArray, outliers: Outliers,
        signal: str, other: str,
    ) -> Iterator[EpisodeFault]:  # fmt: skip
        number, names = self._number(index), self._m.record.names
        times = outliers.deviation[index] / np.maximum(outliers.half[index], self._margin)
        moving = self._m.deviations.count[index] > 0
        if joints.size > 1 and joints.size >= HALF * np.count_nonzero(moving):
            size = float(values[index, joints].max())
            yield EpisodeFault(
                number, "stand-still", None, size, self._unit, None,
                float(times[joints].max()), None,
                f"{joints.size} of {len(names)} joints stand while their {other}s move",
            )  # fmt: skip
            return
        for j in joints.tolist():
            size = float(values[index, j])
            yield EpisodeFault(
                number, "frozen", names[j], size, self._unit, None, float(times[j]), None,
                f"{names[j]}: the {signal} stands while the {other} moves by "
                f"{size:.3g} {self._unit}".rstrip(),
            )  # fmt: skip

    def _largest(self, values: FloatArray, margin: float) -> Outliers:
        return outliers_of(values, np.zeros_like(values), margin, self._level, largest=True)

    def shared(self, skipped: set[int]) -> Iterator[EpisodeFault]:
        """Yield episodes whose joints all lag otherwise, and take that from the joints' lags."""
        lag = np.maximum(self._m.response.lag, QUARTER)
        off = self._values["lag"] - median_of(self._values["lag"])
        scatter = np.hypot(scatter_of(off, self._errors["lag"]), self._errors["lag"]) + TINY
        weights = np.where(np.isfinite(off), lag / scatter, 0.0)
        slower = weighted_median(off / lag, weights)
        error = PER_MEDIAN / np.sqrt(np.sum(weights**2, axis=1) + TINY)
        outliers = outliers_of(slower[:, None], error[:, None], RATE_MATTERS, self._level)
        later = weighted_median(off, np.where(np.isfinite(off), 1 / scatter, 0.0))
        for index in np.flatnonzero(outliers.outside[:, 0]).tolist():
            number = self._number(index)
            if number not in skipped:
                yield self._shared(index, float(slower[index]), float(later[index]), outliers)

    def _shared(
        self, index: int, slower: float, later: float, outliers: Outliers
    ) -> EpisodeFault:
        record, response = self._m.record, self._m.response
        block = block_of(record, self._m.used[[index]])
        pace = pace_of(block, response, 1 + slower, later, self._m.inflation[2])
        half = max(float(outliers.half[index, 0]), RATE_MATTERS)
        times = abs(float(outliers.deviation[index, 0])) / half
        width = WIDTH * float(outliers.error[index, 0])
        if pace.delay:
            self._values["lag"][index] -= pace.delay
            size = pace.delay / record.fps
            width *= float(np.median(response.lag)) / record.fps
            way = "later" if size > 0 else "earlier"
            return EpisodeFault(
                self._number(index), "delay", None, size, "s", (size - width, size + width),
                times, None, f"all joints follow {abs(size) * 1e3:.0f} ms {way}",
                "" if pace.decided else "rate",
            )  # fmt: skip
        self._values["lag"][index] -= response.lag * (pace.rate - 1)
        hz, percent = record.fps * pace.rate, 100 * (pace.rate - 1)
        return EpisodeFault(
            self._number(index), "rate", None, pace.rate, "", (pace.rate - width, pace.rate + width),
            times, None,
            f"recorded at {hz:.3g} Hz ({percent:+.0f} %), if the others are at {record.fps:g} Hz: "
            "all joints lag by so many more frames" if percent > 0 else
            f"recorded at {hz:.3g} Hz ({percent:+.0f} %), if the others are at {record.fps:g} Hz: "
            "all joints lag by so many fewer frames",
            "" if pace.decided else "delay",
        )  # fmt: skip

    def joints(self, skipped: set[int]) -> Iterator[EpisodeFault]:
        """Yield joints whose gain, lag or offset differs."""
        margins = {"gain": GAIN_MATTERS, "lag": LAG_MATTERS, "offset": self._margin}
        outliers = {
            quantity: outliers_of(
                self._values[quantity], self._errors[quantity], margin, self._level
            )
            for quantity, margin in margins.items()
        }
        any_outside: BoolArray = np.logical_or.reduce([o.outside for o in outliers.values()])
        for index, j in np.argwhere(any_outside).tolist():
            if self._number(index) in skipped:
                continue
            # A weak joint rests off, too, and a late one seems weak: the first explains the rest.
            quantity = next(q for q in margins if outliers[q].outside[index, j])
            yield self._joint(index, j, quantity, outliers[quantity], margins[quantity])

    def _joint(
        self, index: int, j: int, quantity: str, outliers: Outliers, margin: float
    ) -> EpisodeFault:
        size = float(outliers.deviation[index, j])
        times = abs(size) / max(float(outliers.half[index, j]), margin)
        width = WIDTH * float(outliers.error[index, j])
        name, fps = self._m.record.names[j], self._m.record.fps
        if quantity == "offset":
            kind, unit, text = "offset", self._unit, f"rests {size:+.3g} {self._unit} off"
        elif quantity == "lag":
            kind, unit, size, width = "delay", "s", size / fps, width / fps
            text = f"follows {abs(size) * 1e3:.0f} ms {'later' if size > 0 else 'earlier'}"
        else:
            kind, unit, size = "gain", "", 1 + size
            text = f"follows with {size:.3g} times the gain"
            if abs(size) >= SCALED or size < 0:
                text = f"states or commands are scaled: {size:.3g} times the gain"
        ends = (size - width, size + width)
        number = self._number(index)
        return EpisodeFault(
            number, kind, name, size, unit, ends, times, None,
            f"{name} {text.rstrip()} than in the other episodes"
            if kind == "delay" else f"{name}: {text.rstrip()}",
        )  # fmt: skip


def weighted_median(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted median of each row; NaN where no weight is, shape (e,)."""
    order = np.argsort(values, axis=1)
    ranked = np.take_along_axis(values, order, axis=1)
    sums = np.cumsum(np.take_along_axis(weights, order, axis=1), axis=1)
    total = sums[:, -1:]
    at = (sums >= total / 2).argmax(axis=1)
    middle = np.take_along_axis(ranked, at[:, None], axis=1)[:, 0]
    return np.where(total[:, 0] > 0, middle, np.nan)


def unit_of(record: Record, episodes: Sequence[int]) -> tuple[str, float]:
    """Return the unit of the states as their values show it, and an offset that matters in it."""
    rows = [slice(int(record.starts[e]), int(record.starts[e + 1])) for e in episodes]
    largest = max((float(np.max(np.abs(record.states[row]), initial=0.0)) for row in rows), default=0)
    if largest > 4 * np.pi:
        return "deg", float(np.degrees(ANGLE_MARGIN_RAD))
    return "rad", ANGLE_MARGIN_RAD
