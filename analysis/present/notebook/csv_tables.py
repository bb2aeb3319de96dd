"""Results as CSV: the joints of one or several sessions as one table, or each table as a file.

Columns are those of the pandas tables, whose names end in their unit: ``lag_rad``, and the ends of
its 95 % interval ``lag_low_rad`` and ``lag_high_rad``. Numbers have all digits that they need; a
value that could not be computed is an empty cell. Text is escaped as
:mod:`.capture.common.csv_text` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from undulog.capture.common.console import refuse_existing
from undulog.capture.common.csv_text import as_text, csv_writer, number_cells
from undulog.capture.common.errors import OutputExistsError, UsageError
from undulog.capture.common.files import part_file

from ...results.analysis import Analysis, GaitFacts, JointResult
from ...results.experiment import Experiment
from .frames import table

SUFFIX = ".csv"


def joint_table(sessions: Sequence[Analysis]) -> pd.DataFrame:
    """Return a row for each joint of each session, over all cycles that were analysed.

    Returns:
        The columns of the table ``joints`` behind ``session``, ``path``, and the first start, last
        stop and number of cycles of the windows that the joint's numbers are of.
    """
    owners = [(one, joint) for one in sessions for joint in one.joints]
    windows = [_windows(one.gait, joint) for one, joint in owners]
    frame = table(
        JointResult,
        [joint for _, joint in owners],
        session=[one.session.id for one, _ in owners],
        path=[one.session.path for one, _ in owners],
        start_s=[each[0] for each in windows],
        stop_s=[each[1] for each in windows],
        cycles=[each[2] for each in windows],
    )
    return frame.drop(columns="dead_band", errors="ignore")  # a structure of its own


def _windows(gait: GaitFacts, joint: JointResult) -> tuple[float, float, float]:
    """Return first start and last stop [s], and number of cycles, of a joint's windows."""
    windows = gait.windows if joint.group is None else gait.groups[joint.group].windows
    windows = windows or gait.windows
    if not windows:
        return float("nan"), float("nan"), 0.0
    return windows[0].start_s, windows[-1].stop_s, sum(one.cycles for one in windows)


def check_csv(path: Path, *, force: bool, several: bool = False) -> None:
    """Check an output path before any work is done.

    Args:
        path: A name that ends in .csv, or a folder, which need not exist.
        several: Whether several results go there, which takes a file.

    Raises:
        OutputExistsError: If the file, or one in the folder, is there and ``force`` is not given.
        UsageError: If the name ends in anything else, or its folder doesn't exist.
    """
    if path.suffix.lower() == SUFFIX:
        refuse_existing(path, force=force)
    elif several:
        raise UsageError(f"{path}: a folder is for the tables of one result; end the name in .csv")
    elif path.suffix and not path.is_dir():
        raise UsageError(f"{path}: end the name in .csv, or name a folder for all tables")
    elif path.is_dir():
        if not force and (there := next(path.glob(f"*{SUFFIX}"), None)):
            raise OutputExistsError(there)
    else:
        refuse_existing(path, force=force)


def write_csv(
    results: Sequence[Analysis | Experiment], path: Path, *, force: bool = False
) -> list[Path]:
    """Write the joints of results to one file, or all tables of one result to a folder.

    Args:
        path: A name that ends in .csv, or a folder, made if it isn't there.
        force: Replace files.

    Returns:
        The files.

    Raises:
        UsageError: If several results are to go into a folder.
        OutputExistsError: If a file is there and ``force`` is not given.
        LogWriteError: If one can't be written.
    """
    check_csv(path, force=force, several=len(results) > 1)
    if path.suffix.lower() == SUFFIX:
        sessions = [
            one
            for result in results
            for one in (result.sessions if isinstance(result, Experiment) else (result,))
        ]
        files = {path: joint_table(sessions)}
    else:
        path.mkdir(exist_ok=True)
        files = {path / f"{name}{SUFFIX}": frame for name, frame in results[0].frames().items()}
    for file in files:
        refuse_existing(file, force=force)
    for file, frame in files.items():
        with part_file(file) as part:
            _write(frame, part)
    return list(files)


def _write(frame: pd.DataFrame, path: Path) -> None:
    columns = [_cells(frame[name]) for name in frame.columns]
    texts = [cell for column in columns for cell in column if isinstance(cell, str)]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv_writer(stream, [*frame.columns, *texts])
        writer.writerow(frame.columns)
        writer.writerows(zip(*columns, strict=True))


def _cells(column: Any) -> list[object]:
    if column.dtype.kind == "f":
        return number_cells(column.to_numpy())
    cells: list[Any] = column.tolist()
    return ["" if pd.isna(cell) else as_text(cell) if isinstance(cell, str) else cell
            for cell in cells]  # fmt: skip
