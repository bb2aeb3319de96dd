"""Name what is wrong with the episodes of a data set.

An episode is compared with the others of its data set: each joint's gain, lag and offset, the lag
that its joints have in common, lost frames, and signals that stand. Each is at a level over all
episodes and joints, with the scatter that the sound episodes have, and is named only from a size
on that matters. Of an episode whose frames were lost nothing else is named: its record has several
times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import some_names
from undulog.capture.judgement.levels import (
    ANGLE_MARGIN_RAD,
    ENOUGH_LIKE,
    FULL,
    HALF,
    QUARTER,
    RARE,
    REST_ERRORS,
    TINY,
    WIDTH,
)

from .deviations import Deviations, searched
from .jumps import Jumps
from .outliers import Outliers, median_of, outliers_of, scatter_of, weighted_median
from .pace import pace_of
from .record import EpisodeBlock, Record, block_of
from .response import EpisodeResponses
from .result import EpisodeFault

LEVEL = 0.02
"""Chance that anything is named in a sound data set."""

FAMILIES = 8
"""Of questions: gain, lag, offset, the lag in common, lost frames, doubled ones, states that stand,
commands that stand."""

MOST_OFTEN = 2
"""Episodes, or a tenth of all, that may have the same fault: more are a group of their own, as of
another task, and no fault."""

LIKELY = 0.05
"""Level from which a joint is looked at again, frame by frame."""

GAIN_MATTERS = 0.05
"""Of a gain: what people who teach vary by is more."""

LAG_MATTERS = HALF
"""Of a lag [frames]: a policy sees whole ones."""

LEFT = 2.0
"""Root mean squares of a sound residual that a deviation's root mean square exceeds."""

RATE_MATTERS = 0.03
"""Of a rate."""

SCALED = 2.0
"""From this factor on a gain isn't a weak joint's, but a signal's that was scaled."""

SEARCHED_S = 0.35
"""Lags on either side of the common one that are searched [s]."""

TOGETHER = 16
"""Episodes that are searched at once: they are a block in memory."""

WORSE = float(np.log(2.0))
"""What is left is this much more (of its logarithm) where an episode is looked at again."""

PER_MEDIAN = 1.2533
"""Standard error of a median over that of a mean, of normal values: root of pi / 2."""


@dataclass(frozen=True)
class MeasuredEpisodes:
    """All that is measured of e episodes and m joints.

    Attributes:
        used: Indices of the episodes that are compared, shape (u,); all arrays are of these.
        sample: Some of the episodes, from which the response was fitted.
        inflation: Of the variances of level, gain and lag, shape (3, m).
        frozen: Motion of the command while the state stands, shape (u, m).
        unasked: Motion of the state while the command stands, shape (u, m).
    """

    record: Record
    used: IntArray
    response: EpisodeResponses
    sample: EpisodeBlock
    deviations: Deviations
    inflation: FloatArray
    jumps: Jumps
    frozen: FloatArray
    unasked: FloatArray


def faults_of(
    measured: MeasuredEpisodes, unit: str, margin: float
) -> tuple[list[EpisodeFault], list[str]]:
    """Return what is wrong, worst first, and what isn't decided.

    Args:
        unit: Of the states.
        margin: An offset that matters, in it.
    """
    _search_again(measured)
    judge = _Judge(measured, unit, margin)
    faults = [*judge.jumps()]
    lost = {fault.episode for fault in faults}
    faults += [fault for fault in judge.standing() if fault.episode not in lost]
    skipped = {fault.episode for fault in faults if fault.joint is None}
    named = {(fault.episode, fault.joint) for fault in faults}
    faults += judge.shared(skipped)
    faults += [
        fault for fault in judge.joints(skipped) if (fault.episode, fault.joint) not in named
    ]
    ranked = sorted(faults, key=lambda fault: (-(fault.times or 0.0), fault.episode))
    return ranked, [*judge.limits, *judge.unknown()]


def values_of(measured: MeasuredEpisodes) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return gain (a factor less 1), lag [frames] and offset of each joint, and their errors.

    Gain and lag are known where a joint had to move by more than what its model leaves of sound
    episodes, and where it follows at all.
    """
    d = measured.deviations
    usual = median_of(d.gain)
    usual = np.where(np.abs(usual) > TINY, usual, 1.0)
    left = median_of(d.left)
    noise = np.sqrt(left * measured.inflation)  # level, gain, lag
    farthest = SEARCHED_S * measured.record.fps
    asked = usual**2 * d.asked >= REST_ERRORS**2 * left
    follows = asked & (d.left <= HALF * d.power) & (d.power > RARE * usual**2 * d.asked)
    values = {
        "gain": np.where(follows, d.gain / usual - 1, np.nan),
        "lag": np.where(follows & (np.abs(d.lag) < farthest), d.lag, np.nan),
        "offset": d.mean - usual * d.middle,
    }
    errors = {
        "gain": np.maximum(d.gain_unit * noise[1], d.gain_error) / np.abs(usual),
        "lag": np.maximum(d.lag_unit * noise[2] / np.abs(usual), d.lag_error),
        "offset": noise[0] / np.sqrt(d.count),
    }
    return values, errors


def _search_again(measured: MeasuredEpisodes) -> None:
    """Search the lags of episodes in which a joint may be off too far for a linear estimate."""
    values, errors = values_of(measured)
    left = np.log(measured.deviations.left + TINY)
    likely = outliers_of(left, np.zeros_like(left), WORSE, LIKELY).outside
    for quantity, margin in (("gain", GAIN_MATTERS), ("lag", LAG_MATTERS)):
        likely |= outliers_of(values[quantity], errors[quantity], margin, LIKELY).outside
    again = np.flatnonzero(likely.any(axis=1))
    if again.size:
        most = max(int(np.ceil(SEARCHED_S * measured.record.fps)), 1)
        for first in range(0, again.size, TOGETHER):
            indices = again[first : first + TOGETHER]
            block = block_of(measured.record, measured.used[indices])
            measured.deviations.put(
                indices, searched(block, measured.response, most, measured.record.fps)
            )


class _Judge:
    """The questions, in their order."""

    def __init__(self, measured: MeasuredEpisodes, unit: str, margin: float) -> None:
        self._m, self._unit, self._margin = measured, unit, margin
        self._values, self._errors = values_of(measured)
        self._level = LEVEL / FAMILIES
        self.limits = list[str]()

    def _few(self, outside: BoolArray, names: Sequence[str]) -> BoolArray:
        """Return what stands out, without what does so in too many episodes for a fault."""
        count = outside.sum(axis=0)
        many = count > np.maximum(MOST_OFTEN, (1 - FULL) * len(outside))
        self.limits += [
            f"{names[k]}: {count[k]} of {len(outside)} episodes differ from the rest; these are "
            "groups, and which of them is right isn't known"
            for k in np.flatnonzero(many).tolist()
        ]
        return outside & ~many

    def _degrees(self, angle: float) -> float:
        return float(np.degrees(angle)) if self._unit == "rad" else angle

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
                if lost and not jumps.middle[index] > HALF:
                    continue  # most joints don't jump
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
            at_s, f"all joints jump at {at_s:.2f} s as if about {count} frame{'s' * (count > 1)} "
            "were missing",
        )  # fmt: skip

    def _is_copy(self, index: int, after: int) -> bool:
        """Return whether a frame has the same states as the one before."""
        row = int(self._m.record.starts[self._m.used[index]]) + after
        rows = self._m.record.states[row - 1 : row + 1]
        return bool(np.array_equal(rows[0], rows[1]))

    def standing(self) -> Iterator[EpisodeFault]:
        """Yield joints whose states or commands stand while the others move."""
        gain = self._values["gain"] + 1
        margin = REST_ERRORS * self._margin
        scaled = (np.abs(gain) > SCALED) | (np.abs(gain) < QUARTER)  # it follows, otherwise
        for signal, values in (("state", self._m.frozen), ("command", self._m.unasked)):
            outliers = self._largest(values, margin)
            stands = self._few(
                outliers.outside & (outliers.deviation > 0) & ~scaled,
                [f"a {signal} that stands, of {name}" for name in self._m.record.names],
            )
            times = outliers.deviation / np.maximum(outliers.half, margin)
            for index in np.flatnonzero(stands.any(axis=1)).tolist():
                joints = np.flatnonzero(stands[index]).tolist()
                yield from self._stands(index, joints, signal, values[index], times[index])

    def _stands(
        self, index: int, joints: list[int], signal: str, sizes: FloatArray, times: FloatArray
    ) -> Iterator[EpisodeFault]:
        number, names = self._number(index), self._m.record.names
        other = "command" if signal == "state" else "state"
        if len(joints) > 1 and len(joints) >= HALF * len(names):
            size, time = float(sizes[joints].max()), float(times[joints].max())
            sentence = f"{len(joints)} of {len(names)} joints stand while their {other}s move"
            yield EpisodeFault(
                number, "stand-still", None, size, self._unit, None, time, None, sentence
            )
            return
        for j in joints:
            size = float(sizes[j])
            sentence = (
                f"{names[j]}: the {signal} stands while the {other} moves by "
                f"{self._degrees(size):.1f} degrees"
            )
            yield EpisodeFault(
                number, "frozen", names[j], size, self._unit, None, float(times[j]), None, sentence
            )

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
        outside = self._few(outliers.outside, ["lag of all joints"])
        for index in np.flatnonzero(outside[:, 0]).tolist():
            if self._number(index) not in skipped:
                yield self._shared(index, float(slower[index]), float(later[index]), outliers)

    def _shared(self, index: int, slower: float, later: float, outliers: Outliers) -> EpisodeFault:
        record, response = self._m.record, self._m.response
        block = block_of(record, self._m.used[[index]])
        pace = pace_of(block, self._m.sample, response, slower, later)
        half = max(float(outliers.half[index, 0]), RATE_MATTERS)
        times = abs(float(outliers.deviation[index, 0])) / half
        width = WIDTH * float(outliers.error[index, 0])
        number, way = self._number(index), "more" if slower > 0 else "fewer"
        if pace.is_rate:
            self._values["lag"][index] -= response.lag * slower
            rate = 1 + slower
            return EpisodeFault(
                number, "rate", None, rate, "", (rate - width, rate + width), times, None,
                f"recorded at {record.fps * rate:.3g} Hz, if the others are at {record.fps:g} Hz: "
                f"all joints lag by {abs(slower):.0%} {way} frames",
                "" if pace.decided else "delay",
            )  # fmt: skip
        self._values["lag"][index] -= later
        size, width = later / record.fps, width * float(np.median(response.lag)) / record.fps
        return EpisodeFault(
            number, "delay", None, size, "s", (size - width, size + width), times, None,
            f"all joints follow {abs(size) * 1e3:.0f} ms {'later' if size > 0 else 'earlier'}",
            "" if pace.decided else "rate",
        )  # fmt: skip

    def unknown(self) -> Iterator[str]:
        """Yield which joints' gains and lags are known in too few episodes."""
        few = np.isfinite(self._values["gain"]).sum(axis=0) < ENOUGH_LIKE
        names = [self._m.record.names[j] for j in np.flatnonzero(few).tolist()]
        if names:
            yield (
                f"gain and lag of {some_names(names, 6)}: they aren't asked to move enough, or "
                "their states don't follow the actions"
            )

    def joints(self, skipped: set[int]) -> Iterator[EpisodeFault]:
        """Yield joints whose gain, lag or offset differs."""
        margins = self._margins()
        outliers = {
            quantity: outliers_of(
                self._values[quantity], self._errors[quantity], margin, self._level
            )
            for quantity, margin in margins.items()
        }
        names = self._m.record.names
        outside = {
            quantity: self._few(o.outside, [f"{quantity} of {name}" for name in names])
            for quantity, o in outliers.items()
        }
        any_outside: BoolArray = np.logical_or.reduce([*outside.values()])
        for index, j in np.argwhere(any_outside).tolist():
            if self._number(index) in skipped:
                continue
            # A weak joint rests off, too, and a late one seems weak: the first explains the rest.
            quantity = next(q for q in margins if outside[q][index, j])
            margin = float(margins[quantity][index, j])
            yield self._joint(index, j, quantity, outliers[quantity], margin)

    def _margins(self) -> dict[str, FloatArray]:
        """Return what matters of gain, lag and offset, shape (u, m) each.

        What a deviation makes of the motion is also more than the model leaves of sound episodes.
        """
        d, root = self._m.deviations, np.sqrt(self._m.deviations.count)
        usual = np.maximum(np.abs(median_of(d.gain)), TINY)
        left = LEFT * np.sqrt(median_of(d.left))
        return {
            "gain": np.maximum(GAIN_MATTERS, left * d.gain_unit * root / usual),
            "lag": np.maximum(LAG_MATTERS, left * d.lag_unit * root / usual),
            "offset": np.broadcast_to(np.maximum(self._margin, left), root.shape),
        }

    def _joint(
        self, index: int, j: int, quantity: str, outliers: Outliers, margin: float
    ) -> EpisodeFault:
        size = float(outliers.deviation[index, j])
        times = abs(size) / max(float(outliers.half[index, j]), margin)
        width = WIDTH * float(outliers.error[index, j])
        name, fps = self._m.record.names[j], self._m.record.fps
        if quantity == "offset":
            kind, unit, text = "offset", self._unit, f"rests {self._degrees(size):+.1f} degrees off"
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


def unit_of(record: Record, episodes: Sequence[int]) -> tuple[str, float]:
    """Return the unit of the states as their values show it, and an offset that matters in it."""
    rows = [slice(int(record.starts[e]), int(record.starts[e + 1])) for e in episodes]
    largest = max(
        (float(np.max(np.abs(record.states[row]), initial=0.0)) for row in rows), default=0
    )
    if largest > 4 * np.pi:
        return "deg", float(np.degrees(ANGLE_MARGIN_RAD))
    return "rad", ANGLE_MARGIN_RAD
