"""Files that a catalogue reads: logs, and files that may hold results.

The logs of a folder are those that commands find in it, also those of which only the write-ahead
log is left. Of a rosbag2 folder size and time are those of its files, so that it is opened again
only when one of them has changed; and of a folder whose metadata.yaml is of another tool that file
is kept in mind as one without rows.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath
from stat import S_ISDIR
from typing import TypeAlias

from undulog.capture.common.errors import InputFileError, UndulogError
from undulog.capture.common.files import check_regular
from undulog.capture.common.object_store import ObjectStore, StoredFile
from undulog.capture.common.part_files import stored_path
from undulog.capture.log.file.bag import is_bag
from undulog.capture.log.file.bag_metadata import METADATA, is_rosbag2
from undulog.capture.log.file.parts import log_paths, walk
from undulog.capture.log.read.facts import (
    LogFacts,
    is_wal_alone,
    read_bag_facts,
    read_facts,
    read_wal_facts,
)
from undulog.capture.log.wal.writer import wal_folder

FOLDER = ".undulog-catalog"
"""Folder of the catalogue, beside the sessions."""

_RESULTS = (".json", ".parquet")

Scanned: TypeAlias = tuple[int, int, int]
"""Size [byte], last change and scan [Unix ns] of a file that was read."""


@dataclass(frozen=True)
class ResultSource(StoredFile):
    """A file or a rosbag2 folder: a log, or what may hold results."""

    is_log: bool = False


def list_sources(store: ObjectStore, earlier: Mapping[str, Scanned]) -> list[ResultSource]:
    """List logs and files that may hold results; none that is known and unchanged is opened.

    Args:
        earlier: Name of each file that was read to its facts then.

    Raises:
        InputFileError: If a folder can't be listed.
    """
    if store.is_local:
        try:
            return [*_local_results(Path(store.base)), *_local_logs(Path(store.base), earlier)]
        except UndulogError:
            raise
        except OSError as error:
            why = f"can't be listed: {error.strerror}"
            raise InputFileError(error.filename or store.base, why) from error
    files = store.files("", [".mcap", *_RESULTS], recursive=True)
    paths = ((file, PurePosixPath(file.name)) for file in files)
    return [
        ResultSource(file.name, file.size, file.modified_ns, path.suffix == ".mcap")
        for file, path in paths
        if FOLDER not in path.parts and (path.suffix == ".mcap" or _may_be_result(path))
    ]


def source_facts(store: ObjectStore, source: ResultSource) -> LogFacts:
    """Read the facts of a log from as few of its bytes as have them.

    Raises:
        NotALogError: If it is no log, or a damaged one.
        OSError: If it can't be read.
        MissingExtraError: If it is a recording of ROS, and the package that reads it is missing.
    """
    path = store.path(source.name)
    if not store.is_local:
        with store.filesystem.open_input_file(path) as stream:
            return read_facts(path, source.size, lambda a, b: stream.read_at(b - a, a))
    plain = Path(path)
    if is_wal_alone(plain):
        return read_wal_facts(plain)
    if is_bag(plain):
        return read_bag_facts(plain)
    if plain.is_dir():
        plain = next(plain.glob("*.mcap"))
    stored = stored_path(plain)
    check_regular(stored)
    with open(stored, "rb", buffering=0) as stream:  # noqa: PTH123 - unbuffered
        descriptor = stream.fileno()
        size = os.fstat(descriptor).st_size
        return read_facts(str(plain), size, lambda a, b: os.pread(descriptor, b - a, a))


def _may_be_result(path: PurePath) -> bool:
    """Whether a file may be of ``undulog analyse -o``, or rows of ``undulog sweep``."""
    folder = path.parent.name
    return folder not in ("pending", "settings") if path.suffix == ".json" else folder == "rows"


def _local_results(base: Path) -> list[ResultSource]:
    sources: list[ResultSource | None] = []
    for here, folders, files in walk(base):
        folders[:] = [name for name in folders if name != FOLDER]
        paths = (here / name for name in files if name.endswith(_RESULTS))
        sources += [_source(base, path) for path in paths if _may_be_result(path)]
    return [source for source in sources if source is not None]


def _local_logs(base: Path, earlier: Mapping[str, Scanned]) -> list[ResultSource]:
    """Return the logs of a folder, and each metadata.yaml there that is of another tool."""
    others: list[ResultSource] = []

    def is_recording(folder: Path) -> bool:
        whole, metadata = _source(base, folder, is_log=True), _source(base, folder / METADATA)
        if whole is None or metadata is None:
            return False
        if _is_known(whole, earlier):
            return True
        if not _is_known(metadata, earlier) and is_rosbag2(folder):
            return True
        others.append(metadata)
        return False

    paths = dict.fromkeys(log_paths(base, is_recording))
    logs = (_source(base, path, is_log=True) for path in paths)
    return [*(log for log in logs if log is not None), *others]


def _is_known(source: ResultSource, earlier: Mapping[str, Scanned]) -> bool:
    return earlier.get(source.name, ())[:2] == (source.size, source.modified_ns)


def _source(base: Path, path: Path, *, is_log: bool = False) -> ResultSource | None:
    """Return a file or folder; None if it was removed meanwhile.

    A session whose file is missing or empty has the size and time of its write-ahead log.

    Raises:
        InputFileError: If its name is not UTF-8.
    """
    name = path.relative_to(base).as_posix()
    if not name.isprintable() and name != name.encode(errors="replace").decode():
        raise InputFileError(path, "its name is not UTF-8, which a catalogue needs; rename it")
    try:
        at = wal_folder(path) if is_log and is_wal_alone(path) else stored_path(path)
        facts = at.stat()
        parts = [facts]
        if S_ISDIR(facts.st_mode):
            with os.scandir(at) as entries:
                parts = [entry.stat() for entry in entries if entry.is_file()] or parts
    except FileNotFoundError:
        return None
    size, modified_ns = sum(part.st_size for part in parts), max(part.st_mtime_ns for part in parts)
    return ResultSource(name, size, modified_ns, is_log)
