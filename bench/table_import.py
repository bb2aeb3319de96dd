"""Import of tables, against the readers of the same files: pandas.read_csv, and pyarrow.

Each pair reads the same file in the same run, in turn; the ratio of processor time counts, that of
wall time, where both use the threads that they like, is printed beside it. The peer only reads; the
import also writes a new session, one message a row.

Run: python bench/table_import.py [--rows 60000] [--runs 3]
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from measuring import Took, arguments, in_turn, took
from pyarrow import parquet as arrow_parquet
from records import compared, versions

from undulog.capture.exchange.formats.lerobot.importing import import_lerobot
from undulog.capture.exchange.registry.registry import open_table
from undulog.capture.exchange.table_import import import_tables, of_files, prepared

arrow: Any = pa  # its types are incomplete
parquet: Any = arrow_parquet
JOINTS = 25
BAR = 4.0


def write_csv(path: Path, rows: int) -> None:
    """Write times, and position and command of each joint."""
    t = np.arange(rows) * 0.01
    q = np.sin(t[:, None] - 0.5 * np.arange(JOINTS))
    columns = {"time_s": t}
    for k in range(JOINTS):
        columns[f"joint{k + 1:02d}_pos_rad"] = q[:, k]
        columns[f"joint{k + 1:02d}_cmd_rad"] = 1.1 * q[:, k]
    pd.DataFrame(columns).to_csv(path, index=False)


def write_dataset(folder: Path, rows: int) -> Path:
    """Write a data set of one episode; return its file of frames."""
    data, meta = folder / "data" / "chunk-000", folder / "meta"
    data.mkdir(parents=True)
    meta.mkdir()
    feature = {"dtype": "float32", "shape": [JOINTS], "names": None}
    features = {"action": feature, "observation.state": feature}
    info = {"codebase_version": "v3.0", "fps": 30, "features": features}
    (meta / "info.json").write_text(json.dumps(info))
    values = np.sin(np.arange(rows * JOINTS) * 0.01).astype(np.float32)
    vectors = arrow.FixedSizeListArray.from_arrays(arrow.array(values), JOINTS)
    frames = {"action": vectors, "observation.state": vectors, "frame_index": np.arange(rows)}
    table = arrow.table(frames | {"episode_index": np.zeros(rows, dtype=np.int64)})
    parquet.write_table(table, data / "file-000.parquet")
    return data / "file-000.parquet"


def anew(work: Callable[[], object], out: Path) -> Took:
    """Return the cost of some work; the file that it writes is removed before."""
    out.unlink(missing_ok=True)
    return took(work)


def main() -> int:
    """Write, import and read in turn, print."""
    options = arguments(__doc__, rows=60_000, runs=3).parse_args()
    good = True
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        log, out, columns = folder / "log.csv", folder / "run.mcap", ["action", "observation.state"]
        write_csv(log, options.rows)
        frames = write_dataset(folder / "set", options.rows)
        for what, name, ours, peer in (
            (
                f"import CSV, {options.rows} rows, {JOINTS} joints",
                f"{versions('pandas')} read_csv",
                lambda: import_tables(prepared(of_files(open_table(log))), out),
                lambda: pd.read_csv(log),
            ),
            (
                f"import LeRobot, {options.rows} rows, {JOINTS} joints",
                f"{versions('pyarrow')} read_table",
                lambda: import_lerobot(folder / "set", out),
                lambda: parquet.read_table(frames, columns=columns),
            ),
        ):
            works = partial(anew, ours, out), partial(anew, peer, out)
            in_turn(1, *works)  # what is imported late is imported now
            turns = in_turn(options.runs, *works)
            processor = ([cost.processor_s for cost in side] for side in turns)
            good &= compared(what, *processor, name, bar=BAR)
            wall = ([cost.wall_s for cost in side] for side in turns)
            compared(f"{what}, wall time", *wall, name)
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
