"""LeRobot datasets, v2.1 and v3, into sessions: one an episode.

``meta/info.json`` names the features and their elements; ``data/**/*.parquet`` holds the frames of
one episode a file (v2.1) or of several (v3). ``action`` becomes ``/joint_commands``,
``observation.state`` ``/joint_states``. The times are made from the frame number and ``fps`` there,
which the session's metadata says: the sampling itself left no trace.

Layout: https://github.com/huggingface/lerobot, ``lerobot/datasets``.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..common.arrays import NS
from ..common.errors import ImportFormatError, LogError, UsageError, some_names
from ..common.process import StopRequest
from ..log.read.facts import TIMES_FROM_FPS
from ..robot.bus_map import SESSION_UNIT
from ..robot.description import numbered
from ..robot.model import Quantity, Robot
from .can_import import ImportReport, file_digest
from .column_map import STATES, Column, ColumnMap
from .table_import import TableSet, import_tables
from .tables import Block, TableFile, arrow, vectors_of
from .torch_zip import refuse

FEATURES = {"action": Quantity.COMMAND, "observation.state": Quantity.POSITION}
"""Feature to what it is of each joint."""
_MOST_INFO = 1 << 24  # bytes
_MOST_JOINTS = 1024
_KNOWN = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
"""Features of every dataset that number its frames."""


@dataclass(frozen=True)
class LeRobotDataset:
    """A dataset's description.

    Attributes:
        fps: Frames a second.
        names: Feature to the names of its elements.
        left_out: Features that are not imported.
    """

    folder: Path
    version: str
    robot_type: str
    fps: float
    names: Mapping[str, tuple[str, ...]]
    left_out: tuple[str, ...]

    def files(self) -> list[Path]:
        """Return the files of frames, in order."""
        return sorted(self.folder.glob("data/*/*.parquet"))

    def episodes(self) -> dict[int, list[Path]]:
        """Return the episodes that are there and the files that hold their frames."""
        parquet = arrow("a LeRobot dataset")
        found: dict[int, list[Path]] = {}
        for path in self.files():
            column = _column(parquet, path, "episode_index")
            for episode in np.unique(column).tolist():
                found.setdefault(int(episode), []).append(path)
        if not found:
            raise ImportFormatError(self.folder, "has no frames in data/*/*.parquet")
        return dict(sorted(found.items()))


def is_lerobot(folder: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (folder / "meta" / "info.json").is_file()


def open_lerobot(folder: Path) -> LeRobotDataset:
    """Read a dataset's description.

    Raises:
        ImportFormatError: If it is damaged or has neither actions nor states.
    """
    path = folder / "meta" / "info.json"
    try:
        if path.stat().st_size > _MOST_INFO:
            raise ImportFormatError(path, "is too large")
        info = json.loads(path.read_text(encoding="utf-8"))
        features = cast("dict[str, Any]", info["features"])
        fps = float(info["fps"])
        names = {name: _element_names(features[name]) for name in FEATURES if name in features}
        version, kind = str(info.get("codebase_version", "")), str(info.get("robot_type") or "")
        others = tuple(n for n in features if n not in FEATURES and n not in _KNOWN)
    except LogError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ImportFormatError(path, f"is no description of a LeRobot dataset: {error}") from error
    if not names or not 1e-3 <= fps <= 1e6:
        raise ImportFormatError(path, "names neither action nor observation.state, or no fps")
    return LeRobotDataset(folder, version, kind, fps, names, others)


def _element_names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's elements: a list, a list in a list, or in a table."""
    count = int(feature["shape"][0])
    if not 1 <= count <= _MOST_JOINTS:
        raise ValueError(f"a feature of {count} elements")
    names: Any = feature.get("names")
    while isinstance(names, Mapping):
        names = next(iter(cast("Mapping[str, Any]", names).values()), None)
    listed = cast("list[Any]", names) if isinstance(names, list) else []
    if len(listed) == 1 < count and isinstance(listed[0], list):
        listed = cast("list[Any]", listed[0])
    if len(listed) != count:
        return tuple(numbered("joint", count))
    plain = [
        re.sub(r"[^A-Za-z0-9_-]+", "_", str(name).removesuffix(".pos")).strip("_")
        for name in listed
    ]
    plain = [name if name[:1].isalpha() else f"joint_{name}" for name in plain]
    return tuple(plain) if len(set(plain)) == count else tuple(numbered("joint", count))


def _column(parquet: Any, path: Path, name: str) -> Any:
    try:
        return parquet.read_table(path, columns=[name])[name].to_numpy()
    except Exception as error:  # pyarrow has errors of many bases
        raise ImportFormatError(path, f"has no column {name}: {error}") from error


def import_lerobot(
    folder: Path,
    output: Path,
    *,
    episode: int | None = None,
    robot: Robot | None = None,
    units: Mapping[str, str] | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> list[ImportReport]:
    """Turn the episodes of a dataset into sessions.

    Args:
        output: A folder, in which each episode gets ``episode_000000.mcap``; or a session, for one.
        episode: The one wanted; all of them if None.
        units: ``command`` and ``position`` to unit; rad if not given.

    Raises:
        ImportFormatError: If the dataset is damaged or has no such episode.
        UsageError: If several episodes are to go into one file.
        OutputExistsError: If an output is there and ``force`` is not given.
        MissingExtraError: If pyarrow is not installed.
    """
    dataset = open_lerobot(folder)
    present = dataset.episodes()
    if episode is not None and episode not in present:
        listed = some_names([str(number) for number in present], 10)
        raise ImportFormatError(folder, f"has no episode {episode}; it has {listed}")
    chosen = list(present) if episode is None else [episode]
    single = output.suffix.lower() == ".mcap"
    if single and len(chosen) > 1:
        raise UsageError(
            f"{folder} has {len(chosen)} episodes: give a folder as -o, or --episode N"
        )
    if not single:
        output.mkdir(parents=True, exist_ok=True)
    reports: list[ImportReport] = []
    for number in chosen:
        path = output if single else output / f"episode_{number:06d}.mcap"
        source = _episode(dataset, number, present[number])
        column_map, notes = _map(dataset, units or {})
        report = import_tables(
            source, path, robot=robot, column_map=column_map, said=notes, force=force, stop=stop
        )
        report.robot = robot.name if robot else dataset.robot_type or report.robot
        reports.append(report)
        if not report.complete:
            break
    return reports


def _map(dataset: LeRobotDataset, units: Mapping[str, str]) -> tuple[ColumnMap, list[str]]:
    notes = [f"times made from the frame number and fps = {dataset.fps:g}, as the dataset has them"]
    columns: list[Column] = []
    for feature, names in dataset.names.items():
        quantity = FEATURES[feature]
        unit = units.get(quantity, "")
        if not unit:
            unit = SESSION_UNIT[quantity]
            notes.append(
                f"{feature} taken as {unit}: no unit given (--unit {quantity}=UNIT overrides)"
            )
        columns += [Column(f"{feature}[{i}]", name, quantity, unit) for i, name in enumerate(names)]
    if dataset.left_out:
        notes.append(f"features without a place left out: {some_names(dataset.left_out, 10)}")
    return ColumnMap("time", "ns", tuple(columns)), notes


def _episode(dataset: LeRobotDataset, number: int, paths: Sequence[Path]) -> TableSet:
    parquet = arrow("a LeRobot dataset")
    columns = tuple(f"{name}[{i}]" for name, n in dataset.names.items() for i in range(len(n)))

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        for path in paths:
            block = _frames(parquet, path, dataset, number)
            yield {name: block[name] for name in names}

    table = TableFile(paths[0], ("time", *columns), read, form="lerobot")
    task = _task(parquet, dataset, paths[0], number)
    facts = {
        "import.format": f"lerobot {dataset.version}",
        "import.time": f"made from the frame number and fps = {dataset.fps:g}",
        TIMES_FROM_FPS: f"{dataset.fps:g}",
        "import.episode": str(number),
        "import.robot_type": dataset.robot_type,
        **({"import.task": task} if task else {}),
    }
    # A file may hold several episodes, and each is a session of its own.
    digest = hashlib.sha256(f"{file_digest(paths[0])} {number}".encode()).hexdigest()
    return TableSet(dataset.folder, {STATES: table}, digest=digest, facts=facts)


def _frames(parquet: Any, path: Path, dataset: LeRobotDataset, number: int) -> Block:
    """Return the frames of one episode in a file; only row groups that hold some are read."""
    try:
        table = parquet.read_table(
            path,
            columns=[*dataset.names, "frame_index"],
            filters=[("episode_index", "=", number)],
        )
        frame = table["frame_index"].to_numpy()
        block: Block = {"time": np.rint(frame * (NS / dataset.fps)).astype(np.int64)}
        for name, names in dataset.names.items():
            column = table[name].combine_chunks()
            is_list = "list" in str(column.type)  # LeRobot has one element as a plain number
            vectors = vectors_of(column) if is_list else column.to_numpy()[:, None]
            if vectors.shape != (len(frame), len(names)):
                refuse(path, f"{name} has not {len(names)} elements in each frame, as in info.json")
            block |= {f"{name}[{i}]": vectors[:, i] for i in range(len(names))}
    except LogError:
        raise
    except Exception as error:  # pyarrow has errors of many bases
        raise ImportFormatError(path, f"can't be read: {error}") from error
    return block


def _task(parquet: Any, dataset: LeRobotDataset, path: Path, number: int) -> str:
    """Return the text of an episode's task; empty if the dataset does not say."""
    try:
        table = parquet.read_table(
            path, columns=["task_index"], filters=[("episode_index", "=", number)]
        )
        wanted = int(table["task_index"][0].as_py())
        lines = dataset.folder / "meta" / "tasks.jsonl"
        if lines.is_file():
            with lines.open(encoding="utf-8") as stream:
                entries = [json.loads(line) for line in stream if line.strip()]
            return str(next(e["task"] for e in entries if e["task_index"] == wanted))
        tasks = parquet.read_table(dataset.folder / "meta" / "tasks.parquet").to_pydict()
        texts = next(values for name, values in tasks.items() if name != "task_index")
        return str(texts[tasks["task_index"].index(wanted)])
    except Exception:  # noqa: BLE001 - a text for people only, in files of many makes
        return ""
