"""The frames of all episodes of a LeRobot dataset, as arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....common.arrays import FloatArray, IntArray
from ....common.errors import ImportFormatError
from ...column_blocks import Block, refuse
from ...parquet_blocks import vectors_of
from .importing import FEATURES, LeRobotDataset, integers

ROWS = 1 << 16
"""Rows that are read at once: with 29 joints 15 MB."""

MOST_BYTES = 1 << 32
"""Of commands and states, which are in memory together: of 14 joints at 30 Hz two weeks."""

NUMBERING = ("episode_index", "frame_index")
STAMPS = "timestamp"


@dataclass(frozen=True)
class EpisodeFrames:
    """Frames of several episodes, one after the other.

    Attributes:
        names: Of the m joints that both features have.
        numbers: Of the episodes, increasing, shape (e,).
        starts: Index of the first frame of each, and the number of frames, shape (e + 1,).
        commands: ``action`` of these joints, float32 or float64, shape (f, m).
        states: ``observation.state`` of these joints, likewise.
        frame: ``frame_index``, shape (f,).
        stamps_s: ``timestamp`` [s], shape (f,); None where the dataset has none.
    """

    names: tuple[str, ...]
    numbers: IntArray
    starts: IntArray
    commands: NDArray[np.floating[Any]]
    states: NDArray[np.floating[Any]]
    frame: IntArray
    stamps_s: FloatArray | None


def joint_columns(dataset: LeRobotDataset) -> tuple[tuple[str, ...], list[int], list[int]]:
    """Return the joints that commands and states share, and their columns in both.

    They have the same names, or, where none has, the same positions.

    Raises:
        ImportFormatError: If there are no commands or no states, or no joint is in both.
    """
    missing = [feature for feature in FEATURES if feature not in dataset.names]
    if missing:
        why = f"has no {missing[0]}: episodes are compared by how states follow actions"
        raise ImportFormatError(dataset.folder, why)
    commands, states = (dataset.names[feature] for feature in FEATURES)
    shared = tuple(name for name in states if name in commands)
    if shared:
        return shared, [commands.index(n) for n in shared], [states.index(n) for n in shared]
    if len(commands) != len(states):
        why = f"has {len(commands)} actions and {len(states)} states that share no name"
        raise ImportFormatError(dataset.folder, why)
    return states, [*range(len(states))], [*range(len(states))]


def read_frames(
    dataset: LeRobotDataset, advance: Callable[[int, str], None] = lambda _, __: None
) -> EpisodeFrames:
    """Read commands and states of all episodes.

    Args:
        advance: Called before each file with the number of those that are read, and its name.

    Raises:
        ImportFormatError: If a file is damaged, has no frames or more than fit into memory.
        MissingExtraError: If pyarrow is not installed.
    """
    names, *columns = joint_columns(dataset)
    stamped = STAMPS in dataset.numbering
    required = [*FEATURES, *NUMBERING, *([STAMPS] if stamped else [])]
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in required}
    size = 0
    for done, path in enumerate(dataset.files()):
        advance(done, path.name)
        for block in dataset.reader.blocks(path, required, ROWS):
            for name in NUMBERING:
                parts[name].append(np.array(integers(path, block, name), dtype=np.int64))
            for feature, chosen in zip(FEATURES, columns, strict=True):
                vectors = _vectors(dataset, path, block, feature)
                parts[feature].append(vectors[:, chosen])
                size += parts[feature][-1].nbytes
            if stamped:
                parts[STAMPS].append(np.array(block[STAMPS], dtype=np.float64))
            if size > MOST_BYTES:
                refuse(dataset.folder, f"has more than {MOST_BYTES >> 30} GiB of joint values")
    if not parts[NUMBERING[0]]:
        raise ImportFormatError(dataset.folder, "has no frames in data/*/*.parquet")
    whole = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    return _sorted(names, whole, stamped=stamped)


def _sorted(
    names: tuple[str, ...], whole: dict[str, NDArray[Any]], *, stamped: bool
) -> EpisodeFrames:
    """Return the frames in the order of the episodes; within one they stay in theirs."""
    episode = whole[NUMBERING[0]]
    if np.any(episode[1:] < episode[:-1]):
        order = np.argsort(episode, kind="stable")
        whole = {name: values[order] for name, values in whole.items()}
        episode = whole[NUMBERING[0]]
    numbers, starts = np.unique(episode, return_index=True)
    commands, states = (whole[feature] for feature in FEATURES)
    return EpisodeFrames(
        names,
        numbers.astype(np.int64),
        np.append(starts, episode.size).astype(np.int64),
        commands,
        states,
        whole[NUMBERING[1]],
        whole[STAMPS] if stamped else None,
    )


def _vectors(dataset: LeRobotDataset, path: Any, block: Block, feature: str) -> NDArray[Any]:
    vectors, count = vectors_of(block[feature]), len(dataset.names[feature])
    if vectors.shape[1] != count:
        refuse(path, f"{feature} has not {count} elements in each frame, as in info.json")
    return vectors if vectors.dtype.kind == "f" else vectors.astype(np.float64)
