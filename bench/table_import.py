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
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from measuring import arguments
from numpy.typing import NDArray
from pyarrow import parquet as arrow_parquet
from records import compared, versions

from undulog.capture.exchange.lerobot_import import import_lerobot
from undulog.capture.exchange.table_import import import_tables, open_tables

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


def turns(
    ours: Callable[[], object], peer: Callable[[], object], out: Path, runs: int
) -> NDArray[np.float64]:
    """Return wall and processor times [s] of both, turn by turn, shape (2, 2, runs).

    Args:
        out: What ours writes; removed before each turn.
    """
    took = np.empty((2, 2, runs))
    ours(), peer()  # what is imported late is imported now
    for turn in range(runs):
        for which, work in enumerate((ours, peer)):
            out.unlink(missing_ok=True)
            start = np.array([time.perf_counter(), time.process_time()])
            work()
            took[:, which, turn] = [time.perf_counter(), time.process_time()] - start
    return took


def main() -> int:
    """Write, import and read in turn, print."""
    parser = arguments(__doc__)
    parser.add_argument("--rows", type=int, default=60_000)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
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
                lambda: import_tables(open_tables(log), out),
                lambda: pd.read_csv(log),
            ),
            (
                f"import LeRobot, {options.rows} rows, {JOINTS} joints",
                f"{versions('pyarrow')} read_table",
                lambda: import_lerobot(folder / "set", out),
                lambda: parquet.read_table(frames, columns=columns),
            ),
        ):
            wall, processor = turns(ours, peer, out, options.runs).tolist()
            good &= compared(what, *processor, name, bar=BAR)
            compared(f"{what}, wall time", *wall, name)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
