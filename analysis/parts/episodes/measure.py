"""Measure the episodes of a data set, and name what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import COVERAGE, ENOUGH_LIKE, FEWEST

from .deviations import Deviations, inflation_of, regress
from .judge import MeasuredEpisodes, faults_of, unit_of
from .jumps import Jumps, jumps_of, scale_of
from .record import Record, block_of, blocks_of
from .response import fit_response, sample_of
from .result import EpisodeFault, EpisodesResult
from .stamps import stamped
from .standing import standing_of

SAMPLE = 12
"""Episodes from which the common response is fitted."""

SHORTEST = 2 * FEWEST
"""Frames of an episode that is judged, at least, besides those in which its joints settle."""

ALL_RATES = (
    "a rate that is wrong in all episodes can't be seen: the times of frames are made from their "
    "numbers and fps"
)


def measure_episodes(
    record: Record, name: str, advance: Callable[[int], None] = lambda _: None
) -> EpisodesResult:
    """Compare the episodes of a data set with each other.

    Args:
        name: Of the data set.
        advance: Called with the number of episodes that are done.
    """
    not_judged = dict[str, str]()
    finite = _finite(record)
    long_enough = record.lengths > SHORTEST
    for e in np.flatnonzero(~long_enough).tolist():
        not_judged[str(record.numbers[e])] = f"{int(record.lengths[e])} frames are too few"
    used: IntArray = np.flatnonzero(finite & long_enough)
    limits = [ALL_RATES]
    faults, lag_s = list[EpisodeFault](), tuple[float, ...]()
    unit, margin = unit_of(record, used.tolist())
    if used.size < ENOUGH_LIKE:
        limits.append(f"{used.size} episodes are too few to compare: {ENOUGH_LIKE} at least")
    else:
        measured = _measured(record, used, advance)
        faults, undecided = faults_of(measured, unit, margin)
        limits += undecided
        lag_s = tuple((measured.response.lag / record.fps).tolist())
    faults = [*_by_itself(record, finite, long_enough), *stamped(record), *faults]
    return EpisodesResult(
        name=name,
        fps=record.fps,
        unit=unit,
        episodes=record.numbers.size,
        frames=int(record.starts[-1]),
        joints=record.names,
        lag_s=lag_s,
        faults=tuple(faults),
        not_judged=not_judged,
        leave_out=tuple(sorted({fault.episode for fault in faults})),
        limits=tuple(limits),
    )


def _measured(record: Record, used: IntArray, advance: Callable[[int], None]) -> MeasuredEpisodes:
    motion = _moved(record, record.commands)[used].sum(axis=1)
    sample = block_of(record, used[sample_of(record.lengths[used], motion, SAMPLE)])
    response = fit_response(sample, record.fps)
    first = regress(sample, response)
    scale = scale_of(sample, first, response)
    gain = np.median(first.deviations.gain, axis=0)
    index = np.full(record.numbers.size, -1)
    index[used] = np.arange(used.size)
    joints = len(record.names)
    deviations, jumps = Deviations.empty(used.size, joints), Jumps.empty(used.size)
    frozen, unasked = np.zeros((used.size, joints)), np.zeros((used.size, joints))
    done = 0
    for block in blocks_of(record, used):
        at, regression = index[block.episodes], regress(block, response)
        deviations.put(at, regression.deviations)
        jumps.put(at, jumps_of(block, regression, scale))
        frozen[at], unasked[at] = standing_of(block, regression, gain, record.fps)
        done += at.size
        advance(done)
    inflation = inflation_of(first, record.fps)
    return MeasuredEpisodes(
        record, used, response, sample, deviations, inflation, jumps, frozen, unasked
    )


def _by_itself(record: Record, finite: BoolArray, long_enough: BoolArray) -> Iterator[EpisodeFault]:
    """Yield episodes without numbers, and those in which nothing moves."""
    whole = np.flatnonzero(finite & long_enough)
    still = np.zeros(record.numbers.size, dtype=np.bool_)
    if whole.size:
        moved = np.maximum(_moved(record, record.commands), _moved(record, record.states))
        still[whole] = np.nanmax(moved[whole], axis=1, initial=0.0) < 1 - COVERAGE
    for e in np.flatnonzero(still | ~finite).tolist():
        kind, sentence = "stand-still", "no joint moves"
        if not still[e]:
            kind, sentence = "missing", "commands or states are missing or no numbers"
        yield EpisodeFault(int(record.numbers[e]), kind, None, 0.0, "", None, None, None, sentence)


def _moved(record: Record, values: NDArray[np.floating[Any]]) -> FloatArray:
    """Return the range of each joint in each episode, in parts of its usual one, shape (e, m)."""
    starts = record.starts[:-1]
    ranges = np.maximum.reduceat(values, starts) - np.minimum.reduceat(values, starts)
    usual = np.nanmedian(ranges, axis=0)
    return np.asarray(ranges / np.where(usual > 0, usual, np.inf), dtype=np.float64)


def _finite(record: Record) -> BoolArray:
    """Return which episodes have only numbers, shape (e,)."""
    starts = record.starts[:-1]
    bad = ~(np.isfinite(record.commands).all(axis=1) & np.isfinite(record.states).all(axis=1))
    return np.asarray(np.add.reduceat(bad, starts) == 0, dtype=np.bool_) & (record.lengths > 0)
