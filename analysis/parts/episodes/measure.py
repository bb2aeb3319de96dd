"""Measure the episodes of a data set, and name what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import ENOUGH_LIKE, FEWEST

from .deviations import Deviations, inflation_of, regress
from .judge import Measured, faults_of, unit_of
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
    "a rate that is wrong in all episodes can't be seen: frames have no times but frame number / fps"
)


def measure_episodes(
    record: Record, name: str, advance: Callable[[int], None] = lambda _: None
) -> EpisodesResult:
    """Compare the episodes of a data set with each other.

    Args:
        name: Of the data set.
        advance: Called with the number of episodes that are done.
    """
    not_judged = dict[int, str]()
    finite = _finite(record)
    missing = [
        EpisodeFault(
            int(record.numbers[e]), "missing", None, 1.0, "", None, None, None,
            "commands or states that are no numbers",
        )
        for e in np.flatnonzero(~finite & (record.lengths > 0)).tolist()
    ]  # fmt: skip
    long_enough = record.lengths > SHORTEST
    for e in np.flatnonzero(~long_enough).tolist():
        not_judged[int(record.numbers[e])] = f"{int(record.lengths[e])} frames are too few"
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
    faults = [*missing, *stamped(record), *faults]
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
        limits=tuple(limits),
    )


def _measured(record: Record, used: IntArray, advance: Callable[[int], None]) -> Measured:
    sample = block_of(record, used[sample_of(record.lengths[used], _motion(record, used), SAMPLE)])
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
    return Measured(record, used, response, sample, deviations, inflation, jumps, frozen, unasked)


def _motion(record: Record, used: IntArray) -> FloatArray:
    """Return how far the commands of some episodes go, in the joints' usual range, shape (u,)."""
    starts = record.starts[:-1]
    low = np.minimum.reduceat(record.commands, starts, axis=0)
    high = np.maximum.reduceat(record.commands, starts, axis=0)
    ranges = (high - low).astype(np.float64)[used]
    usual = np.median(ranges, axis=0)
    return np.asarray((ranges / np.where(usual > 0, usual, 1.0)).sum(axis=1), dtype=np.float64)


def _finite(record: Record) -> BoolArray:
    """Return which episodes have only numbers, shape (e,)."""
    starts = record.starts[:-1]
    bad = ~(np.isfinite(record.commands).all(axis=1) & np.isfinite(record.states).all(axis=1))
    return np.asarray(np.add.reduceat(bad, starts) == 0, dtype=np.bool_) & (record.lengths > 0)
