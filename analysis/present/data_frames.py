"""Results as pandas tables, and as CSV: joints of several sessions in one file, or a file a table.

Columns have names that end in their unit: ``lag_rad``, and the ends of its 95 % interval
``lag_low_rad`` and ``lag_high_rad``. In CSV, numbers have all digits that they need; a value that
could not be computed is an empty cell. Text is escaped as :mod:`.capture.common.files` says.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import chain
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from undulog.capture.common.console import refuse_existing
from undulog.capture.common.errors import OutputExistsError, UsageError
from undulog.capture.common.files import as_text, csv_writer, number_cells, part_file

from ..common.estimate import Estimate
from ..parts.artefacts.result import Artefact, Span
from ..parts.body.result import BodyPoint, BodyTravel, Serpenoid
from ..parts.gait.result import GaitFacts
from ..parts.gaits.result import JointInWindow
from ..parts.heterogeneity.result import Index
from ..parts.joints.result import JointResult
from ..parts.oscillators.result import ChainCoupling, OscillatorLink, Rate
from ..parts.tracking.result import JointTracking
from ..results.analysis import Analysis
from ..results.body_connection import PredictedTravel
from ..results.comparison import Comparison, Difference, Equivalence, MetadataChange, NamedJoint
from ..results.coupling import (
    Coupling,
    HeldOut,
    LinearCoupling,
    LocalCoupling,
    Matrix,
    RowCheck,
    ToneCoupling,
)
from ..results.experiment import Experiment, MirrorJoint, OrderedPair, Reversal, Run
from ..results.oscillators import Mode
from .text import shown_parts

_UNITS = ("_rad", "_hz", "_m_s", "_m", "_j", "_s", "_deg")

SUFFIX = ".csv"


Frames = dict[str, pd.DataFrame]


def table(kind: type[Any], rows: Iterable[Any], **more: Iterable[Any]) -> pd.DataFrame:
    """Return dataclasses of one kind as a table.

    An :class:`~.analysis.common.estimate.Estimate` named ``lag_rad`` becomes ``lag_rad``,
    ``lag_low_rad`` and ``lag_high_rad``; a field ``ci95`` becomes ``low`` and ``high``; tuples of
    words are joined by spaces. Fields that hold other structures are left out.

    Args:
        **more: Columns to put first, one value a row.

    Returns:
        One row each; without rows, the columns that every row would have.
    """
    every = [row_of(row) for row in rows]
    frame = pd.DataFrame(every) if every else pd.DataFrame(columns=_columns(kind), dtype="str")
    for place, (name, values) in enumerate(more.items()):
        frame.insert(place, name, list(values))
    return frame


def row_of(record: Any) -> dict[str, Any]:
    """Return a dataclass as a row."""
    row: dict[str, Any] = {}
    for field in fields(record):
        value = getattr(record, field.name)
        if value is None and "float" in str(field.type):
            value = float("nan")
        row |= _cells(field.name, value)
    return row


def ends(name: str) -> tuple[str, str]:
    """Return the columns of an interval's ends, e.g. ``lag_low_rad`` and ``lag_high_rad``."""
    unit = next((unit for unit in _UNITS if name.endswith(unit)), "")
    stem = name.removesuffix(unit)
    return f"{stem}_low{unit}", f"{stem}_high{unit}"


def named(kind: type[Any], indices: Mapping[str, Any]) -> pd.DataFrame:
    """Return a mapping of dataclasses as a table, the keys first."""
    return table(kind, indices.values(), name=list(indices))


def _cells(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Estimate):
        numbers = value.value, *(value.ci95 or (None, None))
        return dict(zip((name, *ends(name)), map(_number, numbers), strict=True))
    if name == "ci95":
        return dict(zip(("low", "high"), map(_number, value or (None, None)), strict=True))
    if isinstance(value, tuple):
        words = cast("tuple[Any, ...]", value)
        return {name: " ".join(words)} if all(isinstance(word, str) for word in words) else {}
    return {} if is_dataclass(value) or isinstance(value, dict) else {name: value}


def _columns(kind: type[Any]) -> list[str]:
    types = {field.name: str(field.type) for field in fields(kind)}
    nested = ("tuple", "dict", "Estimate")
    estimates = [(name, *ends(name)) for name, word in types.items() if word == "Estimate"]
    plain = [name for name, word in types.items() if not word.startswith(nested)]
    return [*plain, *chain.from_iterable(estimates)]


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def frames_of(result: object) -> Frames:  # noqa: PLR0911 - one kind of result a case
    """Return the tables of a result; see :meth:`.analysis.common.estimate.PresentedResult.frames`.

    Raises:
        TypeError: If it is no result of this package.
    """
    match result:
        case Analysis():
            return _of_analysis(result)
        case Experiment():
            return _of_experiment(result)
        case Reversal():
            pairs = table(OrderedPair, result.pairs)
            return {"mirror": table(MirrorJoint, result.joints), "pairs": pairs}
        case LocalCoupling():
            return _of_kicks(result)
        case LinearCoupling():
            return _of_sweep(result)
        case Coupling():
            if result.matrix is None:
                return {"coupling": pd.DataFrame([row_of(result)])}
            names = [str(k + 1) for k in range(len(result.matrix))]
            return {"coupling": pd.DataFrame(_pairs(names) | _entries("coupling", result.matrix))}
        case Comparison():
            return _of_comparison(result)
        case _:
            raise TypeError(f"{type(result).__name__} is no result of analysis")


def _of_analysis(result: Analysis) -> Frames:
    frames = {
        "joints": table(JointResult, result.joints),
        "heterogeneity": named(Index, result.heterogeneity),
        "gait": pd.DataFrame([row_of(result.gait)]),
    }
    if result.gaits:
        joints = [joint for gait in result.gaits for joint in gait.joints]
        whose = [gait for gait in result.gaits for _ in gait.joints]
        frames["gaits"] = table(
            JointInWindow,
            joints,
            start_s=[gait.start_s for gait in whose],
            stop_s=[gait.stop_s for gait in whose],
            frequency_hz=[gait.frequency_hz.value for gait in whose],
            wave=[gait.wave for gait in whose],
        )
    if result.tracking:
        frames["tracking"] = table(JointTracking, result.tracking)
    if result.body is not None:
        models = {"measured": result.body.observed} | result.body.null
        names = [model for model, points in models.items() for _ in points]
        frames["body"] = table(BodyPoint, chain.from_iterable(models.values()), model=names)
    shape = result.body_shape
    if shape is not None and shape.planes:
        planes = [str(plane.plane or "") for plane in shape.planes]
        frames["serpenoid"] = table(
            Serpenoid, [plane.serpenoid for plane in shape.planes], plane=planes
        )
    if shape is not None and shape.travel is not None:
        frames["travel"] = table(BodyTravel, [shape.travel])
    frames["artefacts"] = _artefacts(result.artefacts)
    frames |= _of_parts(result, frames)
    return frames | _oscillators(result.oscillators)


def _of_parts(result: Analysis, taken: Iterable[str]) -> Frames:
    """Return the tables of the parts that other packages add, under the names of the parts."""
    frames: Frames = {}
    for name, part in shown_parts(result).items():
        for k, rows in enumerate(shown.rows for shown in part.tables):
            frame = name if k == 0 else f"{name}_{k + 1}"
            if frame in taken:
                raise UsageError(
                    f"the part {name!r} has a table of the name {frame!r}, as others do"
                )
            if rows:
                kind = cast("type[Any]", type(rows[0]))
                frames[frame] = table(kind, rows)
    return frames


def _of_experiment(result: Experiment) -> Frames:
    sessions = result.sessions
    joints = [joint for session in sessions for joint in session.joints]
    whose = [session.session.path for session in sessions for _ in session.joints]
    frames = {
        "runs": table(Run, result.runs),
        "joints": table(JointResult, joints, session=whose),
        "heterogeneity": named(Index, result.heterogeneity),
    }
    if result.reversal is not None:
        frames = frames_of(result.reversal) | frames
    artefacts = [artefact for session in sessions for artefact in session.artefacts]
    paths = [session.session.path for session in sessions for _ in session.artefacts]
    frames["artefacts"] = _artefacts(artefacts, paths)
    if result.body_connection is not None and result.body_connection.predicted:
        frames["travel"] = table(PredictedTravel, result.body_connection.predicted)
    if result.oscillators is not None:
        frames["modes"] = table(Mode, result.oscillators.modes)
    return frames | frames_of(result.coupling)


def _of_kicks(result: LocalCoupling) -> Frames:
    columns: dict[str, Any] = dict(_pairs(result.joints))
    for symbol in ("P", "R", "G", "S"):
        matrix: Matrix | None = getattr(result, symbol)
        if matrix is not None:
            unit = {"R": "_per_rad", "S": "_rad"}.get(symbol, "")
            columns |= _entries(f"{symbol}{unit}", matrix.value)
            columns |= _entries(f"{symbol}_half{unit}", matrix.ci95_half)
    return {
        "coupling": pd.DataFrame(columns),
        "phase_rows": table(RowCheck, result.phase_rows),
        "gain_rows": table(RowCheck, result.gain_rows),
        "held_out": table(HeldOut, result.held_out),
    }


def _of_sweep(result: LinearCoupling) -> Frames:
    parts: list[pd.DataFrame] = []
    for tone in result.tones:
        columns: dict[str, Any] = dict(_pairs(result.joints))
        columns["frequency_hz"] = [tone.frequency_hz] * len(columns["joint"])
        for symbol, unit, matrix in (("H", "", tone.H), ("Z", "_n_m_per_rad", tone.Z)):
            if matrix is not None:
                columns |= _entries(f"{symbol}_real{unit}", matrix.real)
                columns |= _entries(f"{symbol}_imag{unit}", matrix.imag)
                columns |= _entries(f"{symbol}_half{unit}", matrix.ci95_half)
        parts.append(pd.DataFrame(columns))
    return {
        "coupling": pd.concat(parts, ignore_index=True),
        "tones": table(ToneCoupling, result.tones),
    }


def _of_comparison(result: Comparison) -> Frames:
    columns = ("a_rad", "b_rad", "difference_rad", "half_rad")
    waves = [
        pd.DataFrame(
            {"name": waveform.name, "phase_rad": result.phase_rad}
            | {name: getattr(waveform, name) for name in columns}
        )
        for waveform in result.waveforms
    ]
    return {
        "differences": table(Difference, result.differences),
        "named": table(NamedJoint, result.named),
        "equivalence": table(Equivalence, result.equivalence),
        "changed": table(MetadataChange, result.changed),
        "waveforms": pd.concat(waves, ignore_index=True) if waves else pd.DataFrame(),
    }


def _artefacts(artefacts: Sequence[Artefact], paths: Sequence[str] | None = None) -> pd.DataFrame:
    """Return one row a time window; its times are NaN if the artefact lasts throughout."""
    throughout: tuple[Span, ...] = ((float("nan"), float("nan")),)
    rows = [
        (k, span) for k, artefact in enumerate(artefacts) for span in artefact.spans_s or throughout
    ]
    more = {} if paths is None else {"session": [paths[k] for k, _ in rows]}
    frame = table(Artefact, [artefacts[k] for k, _ in rows], **more)
    frame["start_s"] = [start for _, (start, _) in rows]
    frame["stop_s"] = [stop for _, (_, stop) in rows]
    return frame


def _oscillators(chains: Sequence[ChainCoupling]) -> Frames:
    """Return couplings and rates of all chains; no tables without logged phases."""
    if not chains:
        return {}
    frames = {
        "oscillators": table(
            OscillatorLink,
            [link for coupling in chains for link in coupling.links],
            plane=[coupling.plane for coupling in chains for _ in coupling.links],
        ),
        "oscillator_rates": table(
            Rate,
            [rate for coupling in chains for rate in coupling.oscillators],
            plane=[coupling.plane for coupling in chains for _ in coupling.oscillators],
        ),
        "chains": table(ChainCoupling, chains),
    }
    return {name: frame.rename(columns=_with_unit) for name, frame in frames.items()}


def _with_unit(column: str) -> str:
    units = {"K": "per_s", "feedback": "per_s", "omega": "rad_s", "noise": "rad_per_sqrt_s"}
    unit = units.get(column.removesuffix("_low").removesuffix("_high"))
    return column if unit is None else f"{column}_{unit}"


def _pairs(names: Sequence[str]) -> dict[str, list[str]]:
    """Return responding and commanded joints, row by row of a matrix."""
    return {"joint": [name for name in names for _ in names], "commanded": [*names] * len(names)}


def _entries(name: str, rows: Sequence[Sequence[float]]) -> dict[str, list[float]]:
    return {name: np.asarray(rows, dtype=np.float64).ravel().tolist()}


def joint_table(sessions: Sequence[Analysis]) -> pd.DataFrame:
    """Return a row for each joint of each session, over all cycles that were analysed.

    Returns:
        The columns of the table ``joints`` behind ``session``, ``path``, and the first start, last
        stop and number of cycles of the windows that the joint's numbers are of.
    """
    owners = [(session, joint) for session in sessions for joint in session.joints]
    windows = [_windows(session.gait, joint) for session, joint in owners]
    frame = table(
        JointResult,
        [joint for _, joint in owners],
        session=[session.session.id for session, _ in owners],
        path=[session.session.path for session, _ in owners],
        start_s=[window[0] for window in windows],
        stop_s=[window[1] for window in windows],
        cycles=[window[2] for window in windows],
    )
    return frame.drop(columns="dead_band", errors="ignore")  # a structure of its own


def _windows(gait: GaitFacts, joint: JointResult) -> tuple[float, float, float]:
    """Return first start and last stop [s], and number of cycles, of a joint's windows."""
    windows = gait.windows if joint.group is None else gait.groups[joint.group].windows
    windows = windows or gait.windows
    if not windows:
        return float("nan"), float("nan"), 0.0
    return windows[0].start_s, windows[-1].stop_s, sum(window.cycles for window in windows)


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
            session
            for result in results
            for session in (result.sessions if isinstance(result, Experiment) else (result,))
        ]
        files = {path: joint_table(sessions)}
    else:
        path.mkdir(exist_ok=True)
        files = {path / f"{name}{SUFFIX}": frame for name, frame in results[0].frames().items()}
    for file in files:
        refuse_existing(file, force=force)
    for file, frame in files.items():
        write_frame(frame, file)
    return list(files)


def write_frame(frame: pd.DataFrame, file: Path) -> None:
    """Write a table as CSV; what is there is replaced.

    Raises:
        LogWriteError: If it can't be written.
    """
    with part_file(file) as part:
        _write(frame, part)


def _write(frame: pd.DataFrame, path: Path) -> None:
    columns = [_csv_cells(frame[name]) for name in frame.columns]
    texts = [cell for column in columns for cell in column if isinstance(cell, str)]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv_writer(stream, [*frame.columns, *texts])
        writer.writerow(frame.columns)
        writer.writerows(zip(*columns, strict=True))


def _csv_cells(column: Any) -> list[object]:
    if column.dtype.kind == "f":
        return number_cells(column.to_numpy())
    cells: list[Any] = column.tolist()
    return ["" if pd.isna(cell) else as_text(cell) if isinstance(cell, str) else cell
            for cell in cells]  # fmt: skip
