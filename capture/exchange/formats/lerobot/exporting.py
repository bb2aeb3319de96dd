"""Sessions as a LeRobot dataset v3: an episode a session.

``action`` holds the commands, ``observation.state`` the measured positions, in rad and float32.
Frame k of an episode is at its start + k / fps, and holds for each joint the last sample at or
before that time: every value is one that was sampled, none is interpolated. When it was sampled is
in ``sample_time.action`` and ``sample_time.observation.state`` [Unix ns]; their names begin with
neither ``action`` nor ``observation``, so that no policy takes them as an input.

An episode begins where every joint has a sample, and ends with the last one.

Layout: https://github.com/huggingface/lerobot, ``lerobot/datasets``, ``CODEBASE_VERSION`` v3.0.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....bus.decoded_topics import JOINT_TOPIC
from ....common.arrays import NS, FloatArray, IntArray
from ....common.console import progress
from ....common.errors import DataError, MissingChannelError, UsageError, some_names
from ....common.files import check_stop, part_folder
from ....common.process import StopRequest
from ....log.read.session import Session
from ....robot.bus_map import SESSION_UNIT
from ...column_blocks import arrow
from ...reports import ExportReport
from .importing import FEATURES

VERSION = "v3.0"
MARKER = Path("meta", "info.json")
"""The file by which a folder is a dataset."""

_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FILES_PER_CHUNK = 1000
_MOST_FILE_MB = 100
_MOST_FRAMES = 10_000_000
_ROWS_PER_BLOCK = 50_000
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
_NUMBERING = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}

Stats = dict[str, list[float]]


@dataclass(frozen=True)
class HeldSignal:
    """A joint's samples, each held until the next.

    Attributes:
        t_ns: Sampling times [Unix ns], not decreasing, shape (n,), at least one.
        values: Shape (n,), finite.
    """

    joint: str
    t_ns: IntArray
    values: NDArray[np.float32]

    def at(self, frame_ns: IntArray) -> tuple[IntArray, NDArray[np.float32]]:
        """Return time and value of the last sample at or before each frame, shape (k,) each."""
        last = self.t_ns.searchsorted(frame_ns, side="right") - 1
        return self.t_ns[last], self.values[last]


@dataclass(frozen=True)
class Episode:
    """The signals of a session.

    Attributes:
        features: Feature to its signals, one a joint.
        task: What the robot does, as text.
    """

    session_id: str
    robot: str
    features: Mapping[str, Sequence[HeldSignal]]
    task: str

    @property
    def start_ns(self) -> int:
        """Time of the first frame [Unix ns]: every joint has a sample."""
        return max(int(signal.t_ns[0]) for signal in self._signals())

    def frames(self, fps: int) -> int:
        """Return the number of frames."""
        end_ns = max(int(signal.t_ns[-1]) for signal in self._signals())
        return ((end_ns - self.start_ns) * fps + fps // 2) // NS + 1

    def frame_ns(self, frames: IntArray, fps: int) -> IntArray:
        """Return the times of frames [Unix ns], rounded to a whole ns as an import has them."""
        return self.start_ns + (frames * NS + fps // 2) // fps

    def names(self) -> dict[str, list[str]]:
        """Return the joints of each feature."""
        return {
            name: [signal.joint for signal in feature] for name, feature in self.features.items()
        }

    def _signals(self) -> Iterator[HeldSignal]:
        for feature in self.features.values():
            yield from feature


def export_lerobot(
    sources: Sequence[Path],
    output: Path,
    *,
    fps: int,
    task: str | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write sessions as a LeRobot dataset, one episode each; one session is open at a time.

    Args:
        sources: Sessions of one robot, in the order of the episodes.
        output: The folder of the dataset.
        fps: Frames a second.
        task: What the robot does; what the session states if None.
        force: Replace an existing dataset.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If ``fps`` is not positive, or the output is a folder but no dataset.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If a session has neither commands nor joint states.
        DataError: If the sessions have different joints, a joint has no samples, or an episode
            would have too many frames.
        MissingExtraError: If pyarrow is not installed.
        LogWriteError: If it can't be written or the export was stopped; nothing is left behind
            then.
    """
    if not 1 <= fps <= 1_000_000:
        raise UsageError(f"--fps {fps}: frames a second, 1 to 1000000")
    arrow("a LeRobot dataset")
    episodes, warnings = list[int](), list[str]()
    with (
        part_folder(output, marker=MARKER, force=force) as part,
        progress(f"export {output.name}", len(sources)) as bar,
    ):
        writer = _Writer(part, fps)
        try:
            for number, source in enumerate(sources):
                bar.update(number, source.name)
                with Session.open(source, column_folder=output.parent) as session:
                    episode, notes = read_episode(session, task)
                    notes += _losses(episode, fps)
                    episodes.append(writer.add(episode, lambda: check_stop(output, stop)))
                    notes += session.warnings
                prefix = f"{source.name}: " if len(sources) > 1 else ""
                warnings += [f"{prefix}{note}" for note in notes]
        finally:
            writer.close()
        writer.finish()
    count = len(episodes)
    what = f"{sum(episodes)} frames in {count} episode{'' if count == 1 else 's'}"
    return ExportReport(what, {"episodes": episodes, "fps": fps}, warnings)


def read_episode(session: Session, task: str | None = None) -> tuple[Episode, list[str]]:
    """Return the signals of a session, and what of its joints is left out.

    Raises:
        MissingChannelError: If it has neither commands nor joint states.
        DataError: If a joint has no samples, or values that float32 can't hold.
    """
    topics = {name: JOINT_TOPIC[quantity] for name, quantity in FEATURES.items()}
    present = {topic: ["position"] for topic in topics.values() if topic in session.channels}
    if not present:
        missing = " and no ".join(topics.values())
        raise MissingChannelError(session.path, missing, sorted(session.channels))
    notes = [f"no {topic}: no {name}" for name, topic in topics.items() if topic not in present]
    read = session.joint_columns(present)
    features: dict[str, list[HeldSignal]] = {}
    for name, quantity in FEATURES.items():
        signals = read.get((topics[name], "position"))
        if signals is None:
            continue
        if signals.unit != SESSION_UNIT[quantity]:
            notes.append(f"{name} is in {signals.unit}")
        features[name] = [
            _held(session, signals.topic, *samples)
            for samples in zip(signals.names, signals.t_ns, signals.values, strict=True)
        ]
    others = [topic for topic in session.channels if topic not in present]
    if others:
        notes.append(f"not in the dataset: {some_names(sorted(others), 10)}")
    facts = session.metadata.get("undulog", {})
    stated = facts.get("import.task") or facts.get("driven.by") or facts.get("scenario")
    robot = facts.get("robot") or facts.get("import.robot_type") or ""
    return Episode(session.session_id, robot, features, task or stated or "recorded motion"), notes


def _held(
    session: Session, topic: str, joint: str, t_ns: IntArray, values: FloatArray
) -> HeldSignal:
    present = ~np.isnan(values)
    with np.errstate(over="ignore"):
        rounded = values[present].astype(np.float32)
    if not present.any():
        raise DataError(
            f"{session.path}: {topic} has no samples of {joint}, and every frame of a LeRobot "
            "dataset has a value of each joint"
        )
    if not np.isfinite(rounded).all():
        raise DataError(f"{session.path}: {topic}, {joint}: values that are too large for float32")
    return HeldSignal(joint, t_ns if present.all() else t_ns[present], rounded)


def _losses(episode: Episode, fps: int) -> Iterator[str]:
    """Yield what a rate of frames leaves out, one sentence a feature."""
    frame_ns = episode.frame_ns(np.arange(_checked(episode, fps)), fps)
    for name, signals in episode.features.items():
        total = sum(len(signal.t_ns) for signal in signals)
        kept, oldest_ns, joint = 0, -1, ""
        for signal in signals:
            last = signal.t_ns.searchsorted(frame_ns, side="right") - 1
            kept += int((np.diff(last, prepend=-1) != 0).sum())
            age_ns = int((frame_ns - signal.t_ns[last]).max())
            if age_ns > oldest_ns:
                oldest_ns, joint = age_ns, signal.joint
        yield (
            f"{name} at {fps} frames a second: {total - kept} of {total} samples left out, values "
            f"up to {oldest_ns / NS:.3g} s old ({joint}), rounded to float32"
        )


def _checked(episode: Episode, fps: int) -> int:
    count = episode.frames(fps)
    if count > _MOST_FRAMES:
        raise DataError(
            f"session {episode.session_id} would have {count} frames at {fps} a second, more than "
            f"{_MOST_FRAMES}: cut it first (undulog log cut)"
        )
    return count


class _Writer:
    """Files of a dataset."""

    def __init__(self, folder: Path, fps: int) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        self._pa: Any = pa  # its types are incomplete
        self._parquet: Any = parquet
        self._folder, self._fps = folder, fps
        self._file: Any = None
        self._path = folder
        self._number = -1
        self._frames = 0
        self._episodes: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}
        self._stats: list[dict[str, Stats]] = []
        self._first: Episode | None = None

    def add(self, episode: Episode, check: Callable[[], None]) -> int:
        """Write an episode and return its number of frames.

        Args:
            check: Called for each block; may raise.

        Raises:
            DataError: If its joints are not those of the first one.
        """
        self._first = self._first or episode
        for name, joints in {**self._first.names(), **episode.names()}.items():
            names, first = (candidate.names().get(name, []) for candidate in (episode, self._first))
            if names != first:
                odd = some_names(sorted({*names} ^ {*first}), 6) or f"another order of {joints[0]}"
                raise DataError(
                    f"session {episode.session_id}: the joints of {name} aren't those of session "
                    f"{self._first.session_id} ({odd}), and all episodes of a dataset have the same"
                )
        count, number = _checked(episode, self._fps), len(self._episodes)
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        self._open_file()
        for start in range(0, count, _ROWS_PER_BLOCK):
            frames = np.arange(start, min(start + _ROWS_PER_BLOCK, count))
            columns = {**self._signals(episode, frames), **self._numbers(frames, number, task)}
            self._file.write_table(self._pa.table(columns, schema=self._schema()))
            check()
        stats = self._stats_of(episode, count, number, task)
        self._stats.append(stats)
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [episode.task],
                "length": count,
                "data/chunk_index": self._number // _FILES_PER_CHUNK,
                "data/file_index": self._number % _FILES_PER_CHUNK,
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "undulog/session_id": episode.session_id,
                "undulog/start_ns": episode.start_ns,
                **{
                    f"stats/{name}/{k}": v
                    for name, numbers in stats.items()
                    for k, v in numbers.items()
                },
            }
        )
        self._frames += count
        return count

    def close(self) -> None:
        """Close the file of frames."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def finish(self) -> None:
        """Write the description, tasks, episodes and statistics."""
        import pandas as pd

        if self._first is None:
            raise UsageError("a dataset needs at least one session")
        info = {
            "codebase_version": VERSION,
            "robot_type": self._first.robot or None,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": _MOST_FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": _DATA_PATH,
            "video_path": None,
            "features": self._features(),
        }
        path = self._folder / _EPISODES_PATH.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        self._parquet.write_table(self._pa.Table.from_pylist(self._episodes), path)
        meta = self._folder / "meta"
        names = pd.Index(list(self._tasks), name="task")
        pd.DataFrame({"task_index": range(len(names))}, index=names).to_parquet(
            meta / "tasks.parquet"
        )
        _write_json(meta / "stats.json", aggregate_stats(self._stats))
        _write_json(self._folder / MARKER, info)

    def _open_file(self) -> None:
        """Open the next file of frames if there is none, or the last one is large enough."""
        if self._file is not None and self._path.stat().st_size < _MOST_FILE_MB << 20:
            return
        self.close()
        self._number += 1
        chunk, index = divmod(self._number, _FILES_PER_CHUNK)
        self._path = self._folder / _DATA_PATH.format(chunk_index=chunk, file_index=index)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._parquet.ParquetWriter(self._path, self._schema())

    def _features(self) -> dict[str, Any]:
        names = self._first.names() if self._first else {}
        vectors = {
            key: {"dtype": dtype, "shape": [len(joints)], "names": [f"{j}.pos" for j in joints]}
            for prefix, dtype in (("", "float32"), ("sample_time.", "int64"))
            for name, joints in names.items()
            for key in [f"{prefix}{name}"]
        }
        numbers = {n: {"dtype": t, "shape": [1], "names": None} for n, t in _NUMBERING.items()}
        return {**vectors, **numbers}

    def _schema(self) -> Any:
        """Return the columns; LeRobot has a feature of one element as a plain number."""
        kinds = {"float32": self._pa.float32(), "int64": self._pa.int64()}
        return self._pa.schema(
            [
                (name, kinds[feature["dtype"]] if feature["shape"] == [1]
                 else self._pa.list_(kinds[feature["dtype"]], feature["shape"][0]))
                for name, feature in self._features().items()
            ]
        )  # fmt: skip

    def _signals(self, episode: Episode, frames: IntArray) -> dict[str, Any]:
        frame_ns = episode.frame_ns(frames, self._fps)
        columns: dict[str, Any] = {}
        for name, signals in episode.features.items():
            samples = [signal.at(frame_ns) for signal in signals]
            for key, place in ((name, 1), (f"sample_time.{name}", 0)):
                flat = self._pa.array(
                    np.stack([sample[place] for sample in samples], axis=1).ravel()
                )
                single = len(signals) == 1
                columns[key] = (
                    flat if single else self._pa.FixedSizeListArray.from_arrays(flat, len(signals))
                )
        return columns

    def _numbers(self, frames: IntArray, number: int, task: int) -> dict[str, NDArray[Any]]:
        return {
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(len(frames), number),
            "index": self._frames + frames,
            "task_index": np.full(len(frames), task),
        }

    def _stats_of(self, episode: Episode, count: int, number: int, task: int) -> dict[str, Stats]:
        """Return the statistics of each feature, one number an element; a joint at a time."""
        frames = np.arange(count)
        frame_ns = episode.frame_ns(frames, self._fps)
        stats: dict[str, Stats] = {}
        for name, signals in episode.features.items():
            pairs = [tuple(map(_stats, signal.at(frame_ns))) for signal in signals]
            for key, place in ((name, 1), (f"sample_time.{name}", 0)):
                statistics = [pair[place] for pair in pairs]
                stats[key] = {stat: [joint[stat] for joint in statistics] for stat in statistics[0]}
                stats[key]["count"] = [count]
        for name, values in self._numbers(frames, number, task).items():
            stats[name] = {stat: [value] for stat, value in _stats(values).items()}
        return stats


def _stats(values: NDArray[Any]) -> dict[str, float]:
    wide = values.astype(np.float64)
    quantiles = np.quantile(wide, _QUANTILES).tolist()
    return {
        "min": float(wide.min()),
        "max": float(wide.max()),
        "mean": float(wide.mean()),
        "std": float(wide.std()),
        "count": len(wide),
        **{
            f"q{round(100 * q):02d}": quantile
            for q, quantile in zip(_QUANTILES, quantiles, strict=True)
        },
    }


def aggregate_stats(stats: Sequence[Mapping[str, Stats]]) -> dict[str, Stats]:
    """Return the statistics of all episodes from those of each.

    Mean and standard deviation are those of all frames; quantiles are the means of the episodes'
    quantiles by their frames, as LeRobot has them.
    """
    result: dict[str, Stats] = {}
    for name in stats[0]:
        arrays = {
            key: np.array([episode[name][key] for episode in stats]) for key in stats[0][name]
        }
        weights = arrays["count"] / arrays["count"].sum()
        mean = (weights * arrays["mean"]).sum(axis=0)
        variance = (weights * (arrays["std"] ** 2 + (arrays["mean"] - mean) ** 2)).sum(axis=0)
        merged = {key: (weights * values).sum(axis=0) for key, values in arrays.items()}
        merged |= {
            "min": arrays["min"].min(axis=0),
            "max": arrays["max"].max(axis=0),
            "mean": mean,
            "std": np.sqrt(variance),
            "count": arrays["count"].sum(axis=0),
        }
        result[name] = {key: values.tolist() for key, values in merged.items()}
    return result


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=4, allow_nan=False) + "\n", encoding="utf-8")
