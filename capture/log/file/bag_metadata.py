"""The metadata.yaml of a recording of ROS 2: whether a folder is one, and what it states.

It is read as text alone, without merges and tags, and up to a size.

Format: https://github.com/ros2/rosbag2.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, cast

from ...common.errors import NotALogError
from ...common.untrusted_text import check_yaml

METADATA = "metadata.yaml"
LARGEST_METADATA = 1 << 20
"""Of a metadata.yaml [byte]: hours in thousands of parts take less."""

_INFORMATION = "rosbag2_bagfile_information"
_HEAD = 1 << 16  # bytes of a metadata.yaml among which the key of rosbag2, its only one, stands
_KEY = re.compile(  # behind comments and directives, or at the start of a line: not a nested one
    rf"""(?:\A(?:[ \t\r]*(?:[#%].*|---.*)?\n)*[ \t{{]*|^)(["']?){_INFORMATION}\1[ \t]*:""",
    re.MULTILINE,
)
_NONE = ("", "none", "null", "~")
_DIGITS = 19


@dataclass(frozen=True)
class Stated:
    """What is stated of a recording, apart from its messages.

    Attributes:
        files: Its files, in the order of time.
        mode: ``file``, ``message`` or empty: what is compressed.
        start_ns: Time of the first message [Unix ns]; None where no number is stated.
        duration_ns: From the first to the last one [ns].
        messages: Their number.
        topics: Their names.
    """

    files: list[Path]
    mode: str
    start_ns: int | None = None
    duration_ns: int | None = None
    messages: int | None = None
    topics: tuple[str, ...] = ()


def is_rosbag2(folder: Path) -> bool:
    """Return whether a folder has a metadata.yaml of rosbag2, by its key.

    Only the first 64 KiB are read, as text: other tools have files of that name too, of any size,
    and the base install has no YAML parser. A file that can't be read counts, so that opening the
    folder reports why.
    """
    path = folder / METADATA
    if not path.is_file():
        return False
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError:
        return True
    return _KEY.search(head.decode("utf-8-sig", "replace")) is not None


def read_stated(folder: Path) -> Stated:
    """Read the metadata.yaml of a folder.

    Raises:
        NotALogError: If it is damaged, or names files that are not there.
    """
    from ruamel.yaml import YAML

    path = folder / METADATA
    text = metadata_text(path)
    try:
        check_yaml(text)
        # Kinds other than text would be computed: merges of merges expand without limit.
        tree: Any = cast("Any", YAML(typ="base", pure=True)).load(text)
    except Exception as error:  # its parser has errors of many bases
        why = " ".join(str(error).split()) or type(error).__name__
        raise NotALogError(path, f"is no YAML: {why[:200]}; run 'ros2 bag reindex'") from error
    facts = _field(tree, _INFORMATION)
    listed = _list(facts, "relative_file_paths")
    if not listed or not all(isinstance(name, str) for name in listed):
        raise NotALogError(path, "lists no files in relative_file_paths; run 'ros2 bag reindex'")
    files = [folder / PurePath(name).name for name in listed]
    if len(set(files)) < len(files):
        raise NotALogError(path, "names a file twice; run 'ros2 bag reindex'")
    for file in files:
        if "\0" in file.name or not file.is_file():
            raise NotALogError(
                path, f"names {file.name}, which is not there; run 'ros2 bag reindex'"
            )
    mode, form = (_text(facts, f"compression_{name}") for name in ("mode", "format"))
    if mode not in ("", "file", "message", "storage") or (mode and form not in ("zstd", "")):
        raise NotALogError(path, f"states the compression {mode[:40]} by {form[:40]}, not zstd")
    topics = _list(facts, "topics_with_message_count")
    names = (_field(_field(topic, "topic_metadata"), "name") for topic in topics)
    return Stated(
        files,
        mode,
        _number(_field(facts, "starting_time"), "nanoseconds_since_epoch"),
        _number(_field(facts, "duration"), "nanoseconds"),
        _number(facts, "message_count"),
        # An escape may stand for half a character, which no other text holds.
        tuple(n.encode(errors="replace").decode() for n in names if isinstance(n, str)),
    )


def metadata_text(path: Path) -> str:
    """Return the text of a metadata.yaml.

    Raises:
        NotALogError: If it is too large to be one.
        OSError: If it can't be read.
    """
    if path.stat().st_size > LARGEST_METADATA:
        why = f"has more than {LARGEST_METADATA >> 20} MiB; run 'ros2 bag reindex'"
        raise NotALogError(path, why)
    return path.read_text("utf-8", errors="replace")


def _field(tree: object, name: str) -> object:
    return cast("dict[str, object]", tree).get(name) if isinstance(tree, dict) else None


def _list(facts: object, name: str) -> list[Any]:
    value = _field(facts, name)
    return cast("list[Any]", value) if isinstance(value, list) else []


def _text(facts: object, name: str) -> str:
    value = _field(facts, name)
    text = value.strip().lower() if isinstance(value, str) else ""
    return "" if text in _NONE else text


def _number(facts: object, name: str) -> int | None:
    """Return a number that 63 bits hold."""
    text = _text(facts, name)
    if not (text.isascii() and text.isdecimal() and len(text) <= _DIGITS):
        return None
    return number if (number := int(text)) < 1 << 63 else None
