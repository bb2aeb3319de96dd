"""The files of a session, from any of its parts or their folder."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import LogError, NotALogError
from .mcap_file import McapFile
from .part_names import PART_RECORD, later_parts, part_path, split_part_path
from .wal import wal_folder


@dataclass
class PartFiles:
    """The files of a session that are there, opened, in order.

    Attributes:
        files: By number of the part.
        missing: What is missing or left out, one sentence each.
    """

    files: dict[int, McapFile] = field(default_factory=dict[int, McapFile])
    missing: list[str] = field(default_factory=list[str])

    def close(self) -> None:
        """Release all files."""
        for file in self.files.values():
            file.close()


def first_part(path: Path) -> Path:
    """The first part of the session that a path names.

    Args:
        path: Any part, or the folder of one session.

    Returns:
        The first part's file, which need not be there.

    Raises:
        LogError: If a folder holds no session, or several.
    """
    if path.is_dir():
        return _session_in(path)
    head, number = split_part_path(path)
    if number == 1:
        return path
    return head if _is_part(path, head) else path


def open_parts(first: Path, *, bare: bool) -> PartFiles:
    """Open the files of a session.

    Args:
        first: Its first part.
        bare: Whether a write-ahead log can explain files that don't explain themselves, and
            stand in for one that is missing.

    Returns:
        The files.

    Raises:
        NotALogError: If the only file is no log.
        LogError: If the only file can't be opened.
    """
    found = PartFiles()
    try:
        _open_parts(found, first, bare=bare)
    except BaseException:
        found.close()
        raise
    return found


def check_chain(parts: PartFiles) -> list[str]:
    """Hold each part against the hash that the next one has of it.

    Args:
        parts: The files of a session.

    Returns:
        What doesn't fit, one sentence each.
    """
    wrong: list[str] = []
    for number, file in parts.files.items():
        stated = file.metadata.get(PART_RECORD, {}).get("previous_sha256")
        former = parts.files.get(number - 1)
        if stated is None or former is None:
            continue
        with former.path.open("rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        if found != stated:
            wrong.append(
                f"{former.path.name} is not the file that {file.path.name} was recorded after: "
                "its hash is another"
            )
    return wrong


def _open_parts(found: PartFiles, first: Path, *, bare: bool) -> None:
    split = part_path(first, 2).exists()
    try:
        found.files[1] = McapFile(first, bare=bare or split)
        split |= PART_RECORD in found.files[1].metadata
    except LogError as error:
        others = later_parts(first) if first.parent.is_dir() else []
        if not bare and not others:
            raise
        if others or first.exists():
            found.missing.append(f"part 1 can't be read: {error}" if others else str(error))
        split = bool(others)
    if not split:
        return
    for path in later_parts(first):
        _add(found, path, split_part_path(path)[1])
    found.missing += _gaps(found, first, bare=bare)


def _add(found: PartFiles, path: Path, number: int) -> None:
    try:
        file = McapFile(path, bare=True)
    except LogError as error:
        found.missing.append(f"part {number} can't be read: {error}")
        return
    reason = ""
    if PART_RECORD not in file.metadata or file.metadata[PART_RECORD].get("part") != str(number):
        reason = f"does not say that it is part {number}"
    elif any(_session_id(file) != _session_id(other) for other in found.files.values()):
        reason = "is of another session"
    elif _redefines(file, found):
        reason = "describes its channels differently"
    if reason:
        file.close()
        found.missing.append(f"{path.name} {reason}: left out")
        return
    found.files[number] = file


def _gaps(found: PartFiles, first: Path, *, bare: bool) -> list[str]:
    """The parts that must have been and are not there."""
    if not found.files:
        return []
    last = max(found.files)
    gone = [number for number in range(1, last) if number not in found.files]
    end = found.files[last].metadata.get(PART_RECORD, {})
    if "next" in end:
        gone.append(last + 1)
    told = [f"part {number} ({part_path(first, number).name}) is missing" for number in gone]
    if "next" in end:
        told[-1] += "; whether more followed it can't be told"
    elif "parts" not in end and last > 1 and not bare:
        told.append(f"part {last} does not say that it is the last: more may have followed")
    already = {int(text.split()[1]) for text in found.missing if text.startswith("part ")}
    return [text for text in told if not text.startswith(tuple(f"part {k} (" for k in already))]


def _redefines(file: McapFile, found: PartFiles) -> bool:
    known = {key: channel for other in found.files.values() for key, channel in _kinds(other)}
    return any(known.get(key, kind) != kind for key, kind in _kinds(file))


def _kinds(file: McapFile) -> list[tuple[int, tuple[str, str, bytes]]]:
    kinds: list[tuple[int, tuple[str, str, bytes]]] = []
    for key, channel in file.channels.items():
        schema = file.schemas.get(channel.schema_id)
        kind = (channel.topic, schema.name, schema.data) if schema else (channel.topic, "", b"")
        kinds.append((key, kind))
    return kinds


def _session_id(file: McapFile) -> str:
    return file.metadata.get("undulog", {}).get("session_id", "")


def _is_part(path: Path, head: Path) -> bool:
    """Whether a file with the name of a later part is one."""
    try:
        file = McapFile(path, bare=True)
    except LogError:
        return not path.exists() or head.exists() or wal_folder(head).is_dir()
    try:
        return PART_RECORD in file.metadata
    finally:
        file.close()


def _session_in(folder: Path) -> Path:
    """The first part of the only session in a folder."""
    try:
        names = sorted(folder.iterdir())
    except OSError as error:
        raise LogError(folder, f"can't be listed: {error.strerror}") from error
    heads: dict[Path, None] = {}
    for path in names:
        if path.suffix == ".mcap" and path.is_file():
            heads[first_part(path)] = None
        elif path.name.endswith(".mcap.wal") and path.is_dir():
            heads[path.with_name(path.name.removesuffix(".wal"))] = None
    if not heads:
        raise NotALogError(folder, "no session (.mcap) is in this folder")
    if len(heads) > 1:
        listed = ", ".join(path.name for path in heads)
        raise LogError(folder, f"{len(heads)} sessions are in this folder; name one: {listed}")
    return next(iter(heads))
