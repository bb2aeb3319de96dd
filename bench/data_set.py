"""A table of the episodes of a data set for learning, against readers of the same Parquet files.

Thousands of episodes in one file (v3) and in a file each (v2.1). Both sides run in turn in the same
run; the peers only read, undulog reads and compares the episodes. The ratio of wall time counts.

Run: python bench/data_set.py [--episodes 2000] [--frames 300] [--joints 14] [--runs 3]
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from measuring import arguments, in_turn, took
from numpy.typing import NDArray
from pyarrow import parquet as arrow_parquet
from records import compared, versions

from undulog.analysis.commands.data_set import analyse_data_set

arrow: Any = pa  # its types are incomplete
parquet: Any = arrow_parquet
FPS = 30
BAR = 4.0
COLUMNS = ["action", "observation.state", "episode_index", "frame_index", "timestamp"]


def values_of(frames: int, joints: int, seed: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return commands and states of an episode, which follow two frames later, with noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / FPS
    hz, phase = rng.uniform(0.1, 0.5, joints), rng.uniform(0, 6.3, joints)
    commands = 0.5 * np.sin(2 * np.pi * hz * t + phase)
    states = 0.5 * np.sin(2 * np.pi * hz * (t - 2.4 / FPS) + phase)
    states += 0.002 * rng.standard_normal(states.shape)
    return commands.astype(np.float32), states.astype(np.float32)


def table_of(episode: int, frames: int, joints: int) -> Any:
    """Return an episode as a table of Arrow."""
    commands, states = values_of(frames, joints, episode)
    number = np.arange(frames)
    vectors = (
        arrow.FixedSizeListArray.from_arrays(arrow.array(values.ravel()), joints)
        for values in (commands, states)
    )
    columns = [*vectors, np.full(frames, episode), number, (number / FPS).astype(np.float32)]
    return arrow.table(dict(zip(COLUMNS, columns, strict=True)))


def write_data_set(folder: Path, episodes: int, frames: int, joints: int, *, single: bool) -> None:
    """Write a data set: all episodes in a file, or a file each."""
    data, meta = folder / "data" / "chunk-000", folder / "meta"
    data.mkdir(parents=True)
    meta.mkdir()
    feature = {"dtype": "float32", "shape": [joints], "names": None}
    number = {"dtype": "int64", "shape": [1], "names": None}
    features = dict.fromkeys(COLUMNS[:2], feature) | dict.fromkeys(COLUMNS[2:], number)
    info = {"codebase_version": "v3.0" if single else "v2.1", "fps": FPS, "features": features}
    (meta / "info.json").write_text(json.dumps(info))
    tables = (table_of(episode, frames, joints) for episode in range(episodes))
    if single:
        parquet.write_table(arrow.concat_tables(tables), data / "file-000.parquet")
        return
    for episode, table in enumerate(tables):
        parquet.write_table(table, data / f"episode_{episode:06d}.parquet")


def read_by_pandas(files: Sequence[Path]) -> None:
    """Read all files, one after the other."""
    for file in files:
        pd.read_parquet(file, columns=COLUMNS)


def read_by_arrow(files: Sequence[Path]) -> None:
    """Read all files, one after the other."""
    for file in files:
        parquet.read_table(file, columns=COLUMNS)


def measured(what: str, folder: Path, runs: int) -> bool:
    """Analyse and read in turn, print; return whether the bar is met."""
    files = sorted(folder.glob("data/*/*.parquet"))
    good = True
    for peer, read, bar in (
        (f"{versions('pandas')} read_parquet", read_by_pandas, BAR),
        (f"{versions('pyarrow')} read_table", read_by_arrow, None),
    ):
        works = (
            partial(took, partial(analyse_data_set, folder)),
            partial(took, partial(read, files)),
        )
        in_turn(1, *works)  # what is imported late is imported now
        ours, theirs = in_turn(runs, *works)
        ours_s, theirs_s = ([cost.wall_s for cost in side] for side in (ours, theirs))
        good &= compared(what, ours_s, theirs_s, peer, bar=bar)
    return good


def main() -> int:
    """Write data sets in both forms, and measure."""
    options = arguments(__doc__, episodes=2000, frames=300, joints=14, runs=3).parse_args()
    good = True
    with tempfile.TemporaryDirectory() as place:
        for form, single in (("one file", True), ("a file each", False)):
            folder = Path(place) / form.replace(" ", "_")
            write_data_set(folder, options.episodes, options.frames, options.joints, single=single)
            what = f"{options.episodes} episodes of {options.joints} joints in {form}"
            good &= measured(what, folder, options.runs)
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
