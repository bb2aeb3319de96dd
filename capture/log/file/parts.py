"""The files of a session, from any of its parts or their folder, and the logs in a folder.

The parts of a split session are ``run.mcap``, ``run_0002.mcap``, ``run_0003.mcap``, ... The first
part has the requested name, whether the session will be split or not. The marks of a ring are
sessions of their own: ``run_mark0001.mcap``, ... A file that is not whole yet, or never became so,
is a part file (``run_0003.mcap.part``), which is read in the place of the final one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count, takewhile
from pathlib import Path, PurePath

from ...common.errors import InputFileError, LogError, NotALogError, some_names
from ...common.part_files import SUFFIX, finished_path, is_recorders, stored_path
from ...common.remote import RemoteFile, RemotePath
from ..mcap.file import McapFile
from ..wal.writer import wal_folder
from .bag_metadata import METADATA, is_rosbag2
from .content import sha256_of

PART_RECORD = "undulog.part"
"""Metadata record of a part: ``part`` (its number), ``previous`` and ``previous_sha256`` (file
name and hash of the one before), ``next`` (file name of the one after) or, in the last one,
``parts`` (their number). A session that was never split has none."""

_NUMBERED = re.compile(r"(.+)_(\d{4,})")
_MARKED = re.compile(r"(.+)_mark(\d{4,9})", re.DOTALL)
_FILES = (".mcap", ".db3", ".bag")
_WAL = ".mcap.wal"
_UNFINISHED = f".mcap{SUFFIX}"

_MOST_LISTED = 20


def part_path(first: Path, number: int) -> Path:
    """Return the file of a part, e.g. ``run_0002.mcap``; parts are numbered from 1."""
    if number == 1:
        return first
    return first.with_name(f"{first.stem}_{number:04d}{first.suffix}")


def split_part_path(path: Path) -> tuple[Path, int]:
    """Split the name of a part into the first part and the number.

    Returns:
        E.g. ``run.mcap`` and 2 for ``run_0002.mcap``; the path itself and 1 for a name without
        number. Whether the file is a part is stated only in its own record.
    """
    match = _NUMBERED.fullmatch(path.stem)
    if match is None or int(match[2]) < 2:
        return path, 1
    return path.with_name(match[1] + path.suffix), int(match[2])


def mark_path(output: Path, number: int) -> Path:
    """Return the file of a ring's mark, e.g. ``run_mark0001.mcap``; marks are numbered from 1."""
    return output.with_name(f"{output.stem}_mark{number:04d}{output.suffix}")


def mark_number(output: Path, path: Path) -> int:
    """Return the number of a ring's mark; 0 for any other file.

    Args:
        output: The output that names the marks.
    """
    match = _MARKED.fullmatch(path.stem)
    marks = match is not None and match[1] == output.stem and path.suffix == output.suffix
    return int(match[2]) if match is not None and marks else 0


def later_parts(first: Path) -> list[Path]:
    """Return the later parts beside a first part, by number; some may be part files as yet.

    Args:
        first: The first part; it need not exist.

    Raises:
        OSError: If the folder can't be listed.
    """
    paths = {_final(path) for path in first.parent.iterdir()}
    names = [(*split_part_path(path), path) for path in paths]
    return [path for head, number, path in sorted(names) if number > 1 and head == first]


@dataclass
class PartFiles:
    """The existing files of a session, opened, in order.

    Attributes:
        files: By number of the part.
        missing: Missing parts or parts left out, one sentence each.
        paths: All files that were tried, also empty ones.
    """

    files: dict[int, McapFile] = field(default_factory=dict[int, McapFile])
    missing: list[str] = field(default_factory=list[str])
    paths: list[Path] = field(default_factory=list[Path])

    @property
    def finalised(self) -> bool:
        """Whether the last file is complete and names no next one."""
        if not self.files:
            return False
        last = self.files[max(self.files)]
        return not last.cut and "next" not in _part_record(last)

    def close(self) -> None:
        """Release all files."""
        for file in self.files.values():
            file.close()


def first_part(path: Path) -> Path:
    """Return the first part of a session, which need not exist.

    Args:
        path: Any part, its part file, or the folder of one session.

    Raises:
        LogError: If a folder holds no session, or several.
    """
    if path.is_dir():
        return _session_in(path)
    path = path if isinstance(path, RemotePath) else _final(path)
    head, number = split_part_path(path)
    if number == 1:
        return path
    return head if _is_part(path, head) else path


def open_parts(first: Path, *, bare: bool) -> PartFiles:
    """Open the files of a session.

    Args:
        first: Its first part.
        bare: Whether there is a write-ahead log, which has the definitions and messages that files
            lack.

    Raises:
        NotALogError: If the only file is no log.
        LogError: If the only file can't be opened.
    """
    files = PartFiles()
    try:
        _open_parts(files, first, bare=bare)
    except BaseException:
        files.close()
        raise
    return files


def check_chain(parts: PartFiles) -> Iterator[str]:
    """Compare each part with its hash in the next one; yield the faults, one sentence each."""
    for number, file in parts.files.items():
        stated = _part_record(file).get("previous_sha256")
        former = parts.files.get(number - 1)
        if stated is None or former is None:
            continue
        if sha256_of([former.path]) != stated:
            yield (
                f"{former.path.name} is not the file that {file.path.name} was recorded after: "
                "its hash is another"
            )


def _open_parts(files: PartFiles, first: Path, *, bare: bool) -> None:
    paths = {1: first}
    local = not isinstance(first, RemotePath)
    if local and (stored_path(part_path(first, 2)).exists() or not stored_path(first).exists()):
        paths |= _later(first)
    opened: dict[int, McapFile] = {}
    try:
        _open_all(opened, paths, files.missing, bare=bare)
        if len(paths) == 1 and 1 in opened and "next" in _part_record(opened[1]):
            paths |= _later(first)
            rest = {number: path for number, path in paths.items() if number > 1}
            _open_all(opened, rest, files.missing, bare=True)
    finally:
        files.files |= sorted(opened.items())
        files.paths += paths.values()
    for number, file in sorted(opened.items()):
        begun = bare and file.cut and not file.blocks  # died before the first message
        reason = "" if begun else _stranger(opened, number)
        if reason:
            files.missing.append(f"{file.path.name} {reason}: left out")
        if reason or (begun and number > 1):
            del opened[number], files.files[number]
            file.close()
    files.missing += _gaps(files, first, {*paths} if 1 in opened else {*paths} - {1}, bare=bare)


def _open_all(
    opened: dict[int, McapFile], paths: dict[int, Path], missing: list[str], *, bare: bool
) -> None:
    """Open files, the last first, so that a running recording leaves no gap before a part."""
    alone = not bare and len(paths) == 1
    for number, path in reversed(paths.items()):
        try:
            opened[number] = _open(path, bare=not alone)
        except LogError as error:
            if alone:
                _refuse_ring(path)
                raise
            if number > 1 or stored_path(path).exists():
                missing.insert(0, f"part {number} can't be read: {error}")


def _open(path: Path, *, bare: bool) -> McapFile:
    """Open a part, or the part file that it is as yet."""
    stored = path if isinstance(path, RemotePath) else stored_path(path)
    try:
        return McapFile(stored, bare=bare)
    except LogError:
        if stored == path or stored.exists():
            raise
        return McapFile(path, bare=bare)  # it has got its final name since


def _refuse_ring(path: Path) -> None:
    """Raise a LogError if a file isn't there because it is the name of a ring, which has marks."""
    if isinstance(path, RemotePath) or stored_path(path).exists() or not path.parent.is_dir():
        return
    try:
        there = {_final(entry): entry.name for entry in sorted(path.parent.iterdir())}
    except OSError:  # as the error of the file reports it
        return
    if marks := [name for file, name in there.items() if mark_number(path, file)]:
        listed = some_names(marks, _MOST_LISTED)
        raise LogError(path, f"is the name of a ring, which has only marks; name one: {listed}")


def _final(path: Path) -> Path:
    """Return the final name of an ``.mcap``'s part file, unless that name is another file's."""
    final = finished_path(path)
    return final if path.name.endswith(_UNFINISHED) and not final.exists() else path


def _later(first: Path) -> dict[int, Path]:
    """Return the files that have the name of a later part, by number."""
    if isinstance(first, RemotePath):  # a folder can't be listed, the parts are asked for in turn
        numbers = takewhile(lambda number: _is_there(part_path(first, number)), count(2))
        return {number: part_path(first, number) for number in numbers}
    if not first.parent.is_dir():
        return {}
    try:
        return {split_part_path(path)[1]: path for path in later_parts(first)}
    except OSError as error:
        raise LogError(first, f"its folder can't be listed: {error.strerror}") from error


def _is_there(path: Path) -> bool:
    try:
        return isinstance(path, RemotePath) and RemoteFile(path).size > 0
    except InputFileError:
        return False


def _stranger(opened: dict[int, McapFile], number: int) -> str:
    """Return why a file does not belong to those before it; empty if it does."""
    file = opened[number]
    if number > 1 and _part_record(file).get("part") != str(number):
        return f"is not marked as part {number}"
    before = [opened[other] for other in opened if other < number]
    if any(_session_id(file) != _session_id(other) for other in before):
        return "is of another session"
    if _redefines(file, before):
        return "describes its channels differently"
    return ""


def _gaps(files: PartFiles, first: Path, there: set[int], *, bare: bool) -> list[str]:
    """Describe the parts that are missing."""
    if not files.files:
        return []
    last = max(files.files)
    end = _part_record(files.files[last])
    gone = [number for number in range(1, last) if number not in there]
    texts = [f"part {number} ({part_path(first, number).name}) is missing" for number in gone]
    if bare:  # the write-ahead log knows how much was recorded after the last file
        return texts
    if "next" in end and last + 1 not in there:
        name = part_path(first, last + 1).name
        texts.append(f"part {last + 1} ({name}) is missing; whether more followed it is unknown")
    elif "next" not in end and "parts" not in end and last > 1:
        texts.append(f"part {last} is not marked as the last: more may have followed")
    return texts


def _redefines(file: McapFile, others: list[McapFile]) -> bool:
    kinds = {key: kind for other in others for key, kind in _kinds(other)}
    return any(kinds.get(key, kind) != kind for key, kind in _kinds(file))


def _kinds(file: McapFile) -> list[tuple[int, tuple[str, str, bytes]]]:
    types = {key: (schema.name, schema.data) for key, schema in file.schemas.items()}
    return [
        (key, (channel.topic, *types.get(channel.schema_id, ("", b""))))
        for key, channel in file.channels.items()
    ]


def _part_record(file: McapFile) -> dict[str, str]:
    return file.metadata.get(PART_RECORD, {})


def _session_id(file: McapFile) -> str:
    return file.metadata.get("undulog", {}).get("session_id", "")


def _is_part(path: Path, head: Path) -> bool:
    """Whether a file with the name of a later part is one: by its record, or if it is empty."""
    recorded = stored_path(head).exists() or wal_folder(head).is_dir()
    try:
        file = _open(path, bare=True)
    except LogError:
        return recorded or not stored_path(path).exists()
    try:
        return PART_RECORD in file.metadata or (recorded and not file.channels)
    finally:
        file.close()


def _session_in(folder: Path) -> Path:
    """Return the first part of the only session in a folder."""
    try:
        names = sorted(folder.iterdir())
    except OSError as error:
        raise LogError(folder, f"can't be listed: {error.strerror}") from error
    heads: dict[Path, None] = {}
    for path in names:
        if (path.suffix == ".mcap" and path.is_file()) or is_recorders(path):
            heads[first_part(path)] = None
        elif path.name.endswith(".mcap.wal") and path.is_dir():
            heads[path.with_name(path.name.removesuffix(".wal"))] = None
    heads = heads or {first_part(path): None for path in names if path.name.endswith(_UNFINISHED)}
    bag = is_rosbag2(folder)
    if not heads and bag:
        why = "a rosbag2 folder without .mcap; convert it: ros2 bag convert, storage_id: mcap"
        raise NotALogError(folder, why)
    if not heads and (parts := [path.name for path in names if path.suffix == ".db3"]):
        listed = some_names(parts, _MOST_LISTED)
        why = f"has no metadata.yaml of rosbag2; run 'ros2 bag reindex', or name a file: {listed}"
        raise NotALogError(folder, why)
    if not heads:
        raise NotALogError(folder, "no session (.mcap) is in this folder; name a session's file")
    if len(heads) > 1:
        listed = some_names([path.name for path in heads], _MOST_LISTED)
        fix = "join them with undulog log merge" if bag else "name one"
        what = "files of a rosbag2 folder" if bag else "sessions"
        raise LogError(folder, f"{len(heads)} {what} are in this folder; {fix}: {listed}")
    return next(iter(heads))


def walk(folder: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Yield folders with the names of their folders and files, as ``os.walk``, in order of name.

    Links are followed, and a folder that several lead to is visited once. What is removed from a
    list of folders is not entered.

    Raises:
        OSError: If a folder can't be listed.
    """
    left, visited = [folder], set[tuple[int, int]]()
    while left:
        here = left.pop()
        facts = here.stat()
        if (facts.st_dev, facts.st_ino) in visited:
            continue
        visited.add((facts.st_dev, facts.st_ino))
        with os.scandir(here) as listed:
            entries = sorted(listed, key=lambda entry: entry.name)
        folders: list[str] = []
        files: list[str] = []
        for entry in entries:
            # pathlib takes a link to itself as broken, where a DirEntry raises an error.
            kind = Path(entry) if entry.is_symlink() else entry
            if kind.is_dir():
                folders.append(entry.name)
            elif kind.is_file():
                files.append(entry.name)
        yield here, folders, files
        left += [here / name for name in reversed(folders)]


def log_paths(folder: Path, is_recording: Callable[[Path], bool] = is_rosbag2) -> Iterator[Path]:
    """Yield the logs in a folder and, behind them, in its folders, each in order of name.

    A log is a file ``.mcap``, ``.bag`` or ``.db3``, a rosbag2 folder, whose files are not yielded,
    or the file that a recorder's part file or write-ahead log belongs to, which need not exist and
    may be yielded twice. Hidden folders are left out.

    Args:
        is_recording: Whether a folder with a metadata.yaml is one of rosbag2.

    Raises:
        OSError: If a folder can't be listed.
    """
    for here, folders, files in walk(folder):
        if METADATA in files and is_recording(here):
            folders.clear()
            yield here
            continue
        logs = [name for name in files if PurePath(name).suffix in _FILES]
        logs += [name.removesuffix(".wal") for name in folders if name.endswith(_WAL)]
        logs += [finished_path(Path(name)).name for name in files if is_recorders(here / name)]
        yield from (here / name for name in sorted(logs))
        folders[:] = [n for n in folders if not n.startswith(".") and not n.endswith(".wal")]
