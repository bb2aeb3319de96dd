"""Rows of all sweeps in one small table, and what is read from it.

A row keeps its sweep's name (``plan``), its key, changes and session identifier: the run can be
made again with ``undulog sweep`` of the plan, or of a scenario with these changes.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd

from undulog.capture.common.arrays import FloatArray
from undulog.replay.sweep.rows import RowStore

NUMBERS = ("gain_cv", "lag_sd", "lag_sd_low", "lag_sd_high", "energy_cv", "distance_m")
TEXTS = ("key", "setting", "session_id", "status", "error", "changes")
DRIFT = re.compile(r"drifts by ([+-][\d.e-]+) % in gain and ([+-][\d.e-]+) degrees")


def scatter(path: Path, folder: Path, source: str) -> None:
    """Put gathered rows of a source where their sweeps find them, so that none is run again."""
    if not path.is_file():
        return
    frame = pd.read_parquet(path)
    for plan, rows in frame[frame["source"] == source].groupby("plan"):
        there = folder / str(plan) / "rows"
        there.mkdir(parents=True, exist_ok=True)
        rows.assign(session="").to_parquet(there / "gathered.parquet", index=False)


def gather(folder: Path, path: Path) -> None:
    """Write the finished rows of all sweeps under a folder into one Parquet file."""
    stores = sorted(rows_folder.parent for rows_folder in folder.glob("*/rows"))
    sources = {
        file.stem: json.loads(file.read_text())["software"]["source"]
        for file in folder.glob("*/settings/*.json")
    }
    rows = [
        {"plan": store.name, "source": row.get("source") or sources[row["setting"]], **_kept(row)}
        for store in stores
        for row in RowStore(str(store)).rows()
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = pd.DataFrame(rows).sort_values(["plan", "changes", "key"], ignore_index=True)
    frame.to_parquet(path, compression="zstd", index=False)


def _kept(row: dict) -> dict:
    driven = [k for k, gain in enumerate(row.get("gain") or ()) if gain is not None]
    lists = {
        name: [row[name][k] for k in driven] if driven else None
        for name in ("gain", "lag_rad", "energy_net_j")
    }
    drift = [DRIFT.search(text) for text in row.get("warnings") or ()]
    worst = [max(abs(float(m[1])) / 100, np.radians(abs(float(m[2])))) for m in drift if m]
    return {
        **{name: row.get(name) for name in (*TEXTS, *NUMBERS)},
        **lists,
        "drift": row.get("drift", max(worst, default=0.0)),
        "duration_s": row.get("duration_s"),
        "run_wall": row.get("run_wall"),
    }


def read_rows(path: Path) -> pd.DataFrame:
    """Return the rows, each parameter of the sweeps a column, and n, the driven joints."""
    frame = pd.read_parquet(path)
    changes = pd.DataFrame([json.loads(text) for text in frame["changes"]])
    frame = pd.concat([frame, changes.rename(columns=_short)], axis=1)
    frame["n"] = [np.nan if gains is None else float(len(gains)) for gains in frame["gain"]]
    return frame


def _short(key: str) -> str:
    """Return the last part of a key: ``stall_torque`` of ``servo.stall_torque``."""
    return "weakened" if key.startswith("servo_of") else key.rpartition(".")[2]


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, its first 16 digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def responses(rows: pd.DataFrame) -> list[FloatArray]:
    """Return y = ln gain - j lag of each row, shape (n,)."""
    return [
        np.log(np.asarray(gain, dtype=float)) - 1j * np.asarray(lag, dtype=float)
        for gain, lag in zip(rows["gain"], rows["lag_rad"], strict=True)
    ]
