"""LeRobot datasets, v2.1 and v3, into sessions: one an episode.

``meta/info.json`` names the features and their elements; ``data/**/*.parquet`` holds the frames of
one episode a file (v2.1) or of several (v3). ``action`` becomes ``/joint_commands``,
``observation.state`` ``/joint_states``. The times are made from the frame number and ``fps`` there,
which the session's metadata says: the sampling itself left no trace.

Layout: https://github.com/huggingface/lerobot, ``lerobot/datasets``.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ....common.arrays import NS
from ....common.errors import ImportFormatError, LogError, UsageError, some_names
from ....common.process import StopRequest
from ....common.untrusted_text import read_json
from ....log.read.facts import TIMES_FROM_FPS
from ....robot.bus_map import SESSION_UNIT
from ....robot.description import numbered
from ....robot.model import Quantity, Robot
from ...column_blocks import Block, refuse, rows_of_block, spread
from ...column_map import STATES, ColumnMap, MappedColumn
from ...parquet_blocks import ParquetReader, vectors_of
from ...reports import ImportReport
from ...session_import import FLOAT32, file_digest
from ...table_file import TableFile
from ...table_import import TableSet, import_tables

FEATURES = {"action": Quantity.COMMAND, "observation.state": Quantity.POSITION}
"""Feature to what it is of each joint."""
_MOST_INFO = 1 << 24  # bytes
_MOST_JOINTS = 1024
_MOST_TASKS = 1 << 16
_ROWS = 1 << 17
_LEAST_EPISODE = 64
"""Bytes of a file for each episode in it; real ones take kilobytes. Numbers alone pack to nothing,
and each would become a session."""
_KNOWN = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
"""Features of every dataset that number its frames."""


@dataclass(frozen=True)
class LeRobotDataset:
    """A dataset's description.

    Attributes:
        fps: Frames a second.
        names: Feature to the names of its elements.
        left_out: Features that are not imported.
        numbering: Features that number the frames.
        reader: Reads its files.
    """

    folder: Path
    version: str
    robot_type: str
    fps: float
    names: Mapping[str, tuple[str, ...]]
    left_out: tuple[str, ...]
    numbering: tuple[str, ...] = ()
    reader: ParquetReader = field(default_factory=ParquetReader, repr=False, compare=False)

    def files(self) -> list[Path]:
        """Return the files of frames, in order."""
        return sorted(self.folder.glob("data/*/*.parquet"))

    def episodes(self) -> dict[int, list[Path]]:
        """Return the episodes that are there and the files that hold their frames.

        Raises:
            ImportFormatError: If a file is damaged, or numbers more episodes than it can hold.
        """
        paths: dict[int, list[Path]] = {}
        for path in self.files():
            numbers, most = set[int](), path.stat().st_size // _LEAST_EPISODE
            for block in self.reader.blocks(path, ["episode_index"], _ROWS):
                numbers.update(np.unique(integers(path, block, "episode_index")).tolist())
                if len(numbers) > most:
                    refuse(path, f"numbers over {most} episodes, more than its bytes can hold")
            for episode in numbers:
                paths.setdefault(episode, []).append(path)
        if not paths:
            raise ImportFormatError(self.folder, "has no frames in data/*/*.parquet")
        return dict(sorted(paths.items()))


def open_lerobot(folder: Path) -> LeRobotDataset:
    """Read a dataset's description.

    Raises:
        ImportFormatError: If it is damaged or has neither actions nor states.
    """
    path = folder / "meta" / "info.json"
    try:
        if path.stat().st_size > _MOST_INFO:
            raise ImportFormatError(path, "is too large")
        info = read_json(path.read_bytes())
        features = cast("dict[str, Any]", info["features"])
        fps = float(info["fps"])
        names = {name: _element_names(features[name]) for name in FEATURES if name in features}
        version, kind = str(info.get("codebase_version", "")), str(info.get("robot_type") or "")
        others = tuple(n for n in features if n not in FEATURES and n not in _KNOWN)
        numbering = tuple(n for n in features if n in _KNOWN)
    except LogError:
        raise
    except (
        OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError
    ) as error:  # fmt: skip
        raise ImportFormatError(path, f"is no description of a LeRobot dataset: {error}") from error
    if not names or not 1e-3 <= fps <= 1e6:
        raise ImportFormatError(path, "names neither action nor observation.state, or no fps")
    return LeRobotDataset(folder, version, kind, fps, names, others, numbering)


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


def integers(path: Path, block: Block, name: str) -> NDArray[Any]:
    """Return a column of frame or episode numbers."""
    numbers = block[name]
    if numbers.dtype.kind not in "iu" or numbers.ndim != 1:
        refuse(path, f"{name} holds no whole numbers")
    return numbers


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
    digest = cache(file_digest)  # a file may hold many episodes
    for number in chosen:
        path = output if single else output / f"episode_{number:06d}.mcap"
        source = _episode(dataset, number, present[number], digest)
        column_map, notes = _map(dataset, units or {})
        report = import_tables(
            source,
            path,
            robot=robot,
            column_map=column_map,
            map_notes=notes,
            force=force,
            stop=stop,
        )
        report.robot = robot.name if robot else dataset.robot_type or report.robot
        reports.append(report)
        if not report.complete:
            break
    return reports


def _map(dataset: LeRobotDataset, units: Mapping[str, str]) -> tuple[ColumnMap, list[str]]:
    notes = [f"times made from the frame number and fps = {dataset.fps:g}, as the dataset has them"]
    columns: list[MappedColumn] = []
    for feature, names in dataset.names.items():
        quantity = FEATURES[feature]
        unit = units.get(quantity, "")
        if not unit:
            unit = SESSION_UNIT[quantity]
            notes.append(
                f"{feature} taken as {unit}: no unit given (--unit {quantity}=UNIT overrides)"
            )
        columns += [
            MappedColumn(f"{feature}[{i}]", name, quantity, unit) for i, name in enumerate(names)
        ]
    if dataset.left_out:
        notes.append(f"features without a place left out: {some_names(dataset.left_out, 10)}")
    return ColumnMap("time", "ns", tuple(columns)), notes


def _episode(
    dataset: LeRobotDataset,
    number: int,
    paths: Sequence[Path],
    digest_of_file: Callable[[Path], str],
) -> TableSet:
    columns = tuple(f"{name}[{i}]" for name, n in dataset.names.items() for i in range(len(n)))

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        for path in paths:
            for block in _frames(path, dataset, number, rows_of_block(len(columns))):
                yield {name: block[name] for name in names}

    table = TableFile(paths[0], ("time", *columns), read, form="lerobot")
    task = _task(dataset, paths[0], number)
    facts = {
        "import.format": f"lerobot {dataset.version}",
        "import.time": f"made from the frame number and fps = {dataset.fps:g}",
        TIMES_FROM_FPS: f"{dataset.fps:g}",
        "import.episode": str(number),
        "import.robot_type": dataset.robot_type,
        **({"import.task": task} if task else {}),
    }

    def digest() -> str:
        """A file may hold several episodes, and each is a session of its own."""
        return hashlib.sha256(f"{digest_of_file(paths[0])} {number}".encode()).hexdigest()

    return TableSet(dataset.folder, {STATES: table}, digest, facts=facts, compression=FLOAT32)


def _frames(path: Path, dataset: LeRobotDataset, number: int, rows: int) -> Iterator[Block]:
    """Yield the frames of one episode in a file; only row groups that hold some are read."""
    where = "episode_index", number
    for vectors in dataset.reader.blocks(path, [*dataset.names, "frame_index"], rows, where=where):
        frame = integers(path, vectors, "frame_index")
        block: Block = {"time": np.rint(frame * (NS / dataset.fps)).astype(np.int64)}
        for name, names in dataset.names.items():
            elements = vectors_of(vectors[name])
            if elements.shape != (len(frame), len(names)):
                refuse(path, f"{name} has not {len(names)} elements in each frame, as in info.json")
            block |= spread(name, elements)
        yield block


def _task(dataset: LeRobotDataset, path: Path, number: int) -> str:
    """Return the text of an episode's task; empty if the dataset does not say."""
    try:
        where = "episode_index", number
        (block,) = dataset.reader.blocks(path, ["task_index"], 1, where=where, most=1)
        index = int(block["task_index"][0])
        lines = dataset.folder / "meta" / "tasks.jsonl"
        if lines.is_file():
            with lines.open(encoding="utf-8") as stream:
                entries = (read_json(line) for line in stream if line.strip())
                return str(next(e["task"] for e in entries if e["task_index"] == index))
        listing = dataset.folder / "meta" / "tasks.parquet"
        (tasks,) = dataset.reader.blocks(listing, None, _MOST_TASKS, most=1)
        texts = next(values for name, values in tasks.items() if name != "task_index")
        return str(texts[tasks["task_index"].tolist().index(index)])
    except Exception:  # noqa: BLE001 - a text for people only, in files of many makes
        return ""
