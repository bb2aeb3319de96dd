"""The frames of all episodes of a data set, and blocks of episodes of like length."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

BLOCK_VALUES = 1 << 18
"""Values of a block: its arrays stay in the cache of a processor."""


@dataclass(frozen=True)
class Record:
    """Frames of several episodes, one after the other.

    Attributes:
        names: Of the m joints.
        fps: Frames a second, as stated.
        numbers: Of the episodes, shape (e,).
        starts: Index of the first frame of each, and the number of frames, shape (e + 1,).
        commands: Shape (f, m).
        states: Shape (f, m).
        frame: Number of each frame within its episode, shape (f,).
        stamps_s: Stamp of each frame [s], shape (f,); None where there are none.
    """

    names: tuple[str, ...]
    fps: float
    numbers: IntArray
    starts: IntArray
    commands: NDArray[np.floating[Any]]
    states: NDArray[np.floating[Any]]
    frame: IntArray
    stamps_s: FloatArray | None = None

    @property
    def lengths(self) -> IntArray:
        """Frames of each episode, shape (e,)."""
        return np.diff(self.starts)


@dataclass(frozen=True)
class EpisodeBlock:
    """Some episodes side by side.

    Attributes:
        episodes: Their indices in the record, shape (k,).
        inside: Whether an episode has a frame, shape (t, k).
        commands: Shape (t, k, m); beyond its end an episode stays at its last frame.
        states: Likewise.
    """

    episodes: IntArray
    inside: BoolArray
    commands: FloatArray
    states: FloatArray


def block_of(record: Record, episodes: IntArray) -> EpisodeBlock:
    """Return some episodes, which have a frame each at least, as a block."""
    lengths = record.lengths[episodes]
    steps = np.arange(int(lengths.max()))[:, None]
    rows = record.starts[episodes] + np.minimum(steps, lengths - 1)
    return EpisodeBlock(
        episodes,
        steps < lengths,
        record.commands[rows].astype(np.float64, copy=False),
        record.states[rows].astype(np.float64, copy=False),
    )


def blocks_of(record: Record, episodes: IntArray) -> Iterator[EpisodeBlock]:
    """Yield all of these episodes in blocks, the shortest first."""
    lengths = record.lengths[episodes]
    order = episodes[np.argsort(lengths, kind="stable")]
    most = max(BLOCK_VALUES // max(len(record.names), 1), 1)
    first = 0
    while first < order.size:
        stop = first + 1
        while stop < order.size and record.lengths[order[stop]] * (stop + 1 - first) <= most:
            stop += 1
        yield block_of(record, order[first:stop])
        first = stop
