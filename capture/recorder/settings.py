"""Settings of a recording: from the command line, the environment and a file, in that order.

The command line overrides the environment (``UNDULOG_RECORD_RING=30s``), which overrides the file,
which overrides the defaults. All three use the same names and the same spelling of values. An
unknown name is a fault in each of them, and so is a wrong value that another layer overrides.

A file::

    [record]
    sources = ["can:socketcan:can0", "twin:flat"]
    robot = "snake25"               # a shipped robot, or a TOML file beside this one
    bus = "can0"                    # the source that is the robot's bus, where there are several
    output = "run-{time}.mcap"      # {time}: UTC of the start, 20260131T235900Z
    force = false                   # replace an existing output
    duration = "1h30min"            # end by itself; never by default
    split_size = "1GB"              # a new part after this size
    split_time = "10min"            # and after this time
    ring = "30s"                    # keep the last 30 s in memory, write them when marked
    floor = "500MB"                 # end in good order when less disk is free
    socket = "/run/undulog/a.sock"  # where status, mark, split and stop come in
    live = false                    # show it in Rerun
    operator = "who"
    notes = "wet sand"
    fast = false                    # a twin as fast as it can
    quiet = false                   # nothing on the terminal
    metadata = { place = "tank 2" } # further facts for the session

Required are ``sources`` and ``output``. A parser takes a value of TOML, a text or a value of the
command line and returns the setting, or raises a DataError whose text is a valid form.
"""

from __future__ import annotations

import os
import re
import shlex
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, cast

from ..common.amounts import SIZE_UNITS, parse_duration_s, parse_size
from ..common.errors import DataError, SettingsError
from ..common.files import is_file, read_input
from ..common.strict_table import Faults, listed, shown
from ..common.untrusted_text import read_toml

_Number = TypeVar("_Number", int, float)

_YES, _NO = ("true", "1", "yes", "on"), ("false", "0", "no", "off")
_FACT = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")

ENVIRONMENT_PREFIX = "UNDULOG_RECORD_"
"""Begins the name of every environment variable that is a setting."""

FILE_VARIABLE = f"{ENVIRONMENT_PREFIX}SETTINGS"
"""Names the settings file unless the command line does."""

DEFAULT_FLOOR = 500 * SIZE_UNITS["MB"]
"""A recording ends in good order when less disk is free [B]."""


def _flag(value: object) -> bool:
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.lower() in _YES + _NO:
        return value.lower() in _YES
    raise DataError("true or false")


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise DataError("a string")
    return value


def _word(value: object) -> str:
    text = _text(value)
    if not text.strip() or "\n" in text:
        raise DataError("a string, not empty, on one line")
    return text


def _path(value: object) -> Path:
    if isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    if isinstance(value, Path):
        return value
    raise DataError("a path")


def _output(value: object) -> Path:
    path = _path(value)
    if path.suffix.lower() != ".mcap":
        raise DataError("a file that ends in .mcap")
    return path


def _words(value: object) -> list[str]:
    """Strings of an array, or of one text as a shell would split it."""
    if isinstance(value, str):
        try:
            return shlex.split(value)
        except ValueError as error:  # an open quote
            raise DataError("words with every quote closed") from error
    entries = list(cast("list[object]", value)) if isinstance(value, list | tuple) else [None]
    if not all(isinstance(entry, str) for entry in entries):
        raise DataError("an array of strings")
    return cast("list[str]", entries)


def _sources(value: object) -> tuple[str, ...]:
    words = _words(value)
    if not words or not all(":" in word for word in words) or len(set(words)) != len(words):
        raise DataError("one or more different source addresses, e.g. can:socketcan:can0")
    return tuple(words)


def _facts(value: object) -> Mapping[str, str]:
    """Facts of a table, or of ``KEY=VALUE`` words."""
    valid = "names with strings, e.g. place=tank; a name has letters, digits, _, - and ."
    if isinstance(value, Mapping):
        facts = dict(cast("Mapping[object, object]", value))
    else:
        words = _words(value)
        if not all("=" in word for word in words):
            raise DataError(valid)
        pairs = [word.split("=", 1) for word in words]
        facts = dict(cast("list[tuple[object, object]]", pairs))
        if len(facts) != len(pairs):
            raise DataError("each name once")
    for name, text in facts.items():
        if not (isinstance(name, str) and _FACT.fullmatch(name) and isinstance(text, str)):
            raise DataError(valid)
    return MappingProxyType(cast("dict[str, str]", facts))


def _at_least(
    parse: Callable[[object], _Number], least: _Number, valid: str
) -> Callable[[object], _Number]:
    def checked(value: object) -> _Number:
        amount = parse(value)
        if amount < least:
            raise DataError(valid)
        return amount

    return checked


def _read_by(parse: Callable[[object], Any]) -> Mapping[str, Callable[[object], Any]]:
    """Metadata of a field that is a setting."""
    return {"parse": parse}


_AT_LEAST_1_S = _read_by(_at_least(parse_duration_s, 1.0, "a duration of at least 1s"))


@dataclass(frozen=True)
class RecordSettings:
    """The settings of ``undulog record``.

    Attributes:
        sources: Addresses of the sources, at least one.
        output: The session to write, ``.mcap``.
        robot: A shipped robot or a robot TOML; None for that of a source.
        bus: Name of the source that is the robot's bus; None for the only one.
        force: Replace an existing output.
        duration_s: End by itself after this time [s]; None for never.
        split_size: A new part after this size [B]; None for no limit.
        split_time_s: A new part after this time [s]; None for no limit.
        ring_s: Keep so much in memory and write it when marked [s]; None to write everything.
        floor: End in good order when less disk is free [B].
        socket: The control socket; None for the default one.
        live: Show the recording in Rerun.
        operator: Who records.
        notes: Free text for the session.
        metadata: Further facts for the session.
        fast: A twin runs as fast as it can.
        quiet: Nothing on the terminal.
        origin: Where each setting comes from: ``command line``, ``environment``, the file's path,
            or ``default``.
    """

    sources: tuple[str, ...] = field(metadata=_read_by(_sources))
    output: Path = field(metadata=_read_by(_output))
    robot: str | None = field(default=None, metadata=_read_by(_word))
    bus: str | None = field(default=None, metadata=_read_by(_word))
    force: bool = field(default=False, metadata=_read_by(_flag))
    duration_s: float | None = field(
        default=None,
        metadata=_read_by(_at_least(parse_duration_s, 0.001, "a duration of at least 1ms")),
    )
    split_size: int | None = field(
        default=None,
        metadata=_read_by(_at_least(parse_size, SIZE_UNITS["MB"], "a size of at least 1MB")),
    )
    split_time_s: float | None = field(default=None, metadata=_AT_LEAST_1_S)
    ring_s: float | None = field(default=None, metadata=_AT_LEAST_1_S)
    floor: int = field(default=DEFAULT_FLOOR, metadata=_read_by(parse_size))
    socket: Path | None = field(default=None, metadata=_read_by(_path))
    live: bool = field(default=False, metadata=_read_by(_flag))
    operator: str = field(default="", metadata=_read_by(_word))
    notes: str = field(default="", metadata=_read_by(_text))
    metadata: Mapping[str, str] = field(default_factory=dict[str, str], metadata=_read_by(_facts))
    fast: bool = field(default=False, metadata=_read_by(_flag))
    quiet: bool = field(default=False, metadata=_read_by(_flag))
    origin: Mapping[str, str] = field(default_factory=dict[str, str], compare=False)


_FIELDS = {
    setting.name.removesuffix("_s"): setting
    for setting in fields(RecordSettings)
    if setting.metadata
}

PARSERS: Mapping[str, Callable[[object], Any]] = MappingProxyType(
    {name: setting.metadata["parse"] for name, setting in _FIELDS.items()}
)
"""Name of a setting to the parser of its value."""


@dataclass(frozen=True)
class _Layer:
    """Settings of one origin; an absent or None value is not set."""

    origin: str
    values: Mapping[str, object]
    spell: Callable[[str], str]


def resolve(
    cli: Mapping[str, object],
    environ: Mapping[str, str],
    file: Path | None = None,
    *,
    now_ns: int | None = None,
) -> RecordSettings:
    """Combine the layers.

    Args:
        cli: Options of the command line, by the names of the file (``split_size``, not
            ``split_size_bytes``); None for one that is not set.
        environ: The environment.
        file: The settings file; None for that of ``UNDULOG_RECORD_SETTINGS``, if any.
        now_ns: Unix time for ``{time}`` in the output [ns]; that of the call if None.

    Raises:
        InputFileError: If the file doesn't exist or can't be read.
        SettingsError: If there are faults; lists all of them, of all layers.
        TypeError: If ``cli`` has a name that no setting has.
    """
    if unknown := sorted(set(cli) - set(PARSERS)):
        raise TypeError(f"no such settings: {', '.join(unknown)}")
    faults = Faults()
    layers = [_command_line(cli), _environment(environ, faults)]
    if file is None and environ.get(FILE_VARIABLE):
        file = Path(environ[FILE_VARIABLE])
    if file is not None:
        layers.append(_file(file, faults))
    values: dict[str, Any] = {}
    given: dict[str, tuple[_Layer, object]] = {}
    for name, parse in PARSERS.items():
        for layer in layers:
            raw = layer.values.get(name)
            if raw is None:
                continue
            value = _parsed(layer, name, raw, parse, faults)
            if name not in given:
                given[name] = layer, raw
                values[_FIELDS[name].name] = value
    _check_together(given, faults)
    if noted := faults.all():
        raise SettingsError(noted)
    origin = {name: given[name][0].origin if name in given else "default" for name in PARSERS}
    if file is not None and origin["robot"] == _origin(file):
        values["robot"] = _robot_file(file, values["robot"])
    values["output"] = _timed(values["output"], time.time_ns() if now_ns is None else now_ns)
    return RecordSettings(**values, origin=origin)


def _command_line(cli: Mapping[str, object]) -> _Layer:
    # An option that can be repeated is an empty tuple by default.
    given = {name: None if value == () else value for name, value in cli.items()}

    def spell(name: str) -> str:
        return "SOURCE" if name == "sources" else f"--{name.replace('_', '-')}"

    return _Layer("command line", given, spell)


def _environment(environ: Mapping[str, str], faults: Faults) -> _Layer:
    def spell(name: str) -> str:
        return f"{ENVIRONMENT_PREFIX}{name.upper()}"

    variables = {spell(name): name for name in PARSERS}
    values: dict[str, object] = {}
    for variable, text in environ.items():
        if not variable.startswith(ENVIRONMENT_PREFIX) or variable == FILE_VARIABLE:
            continue
        if variable in variables:
            values[variables[variable]] = text
        else:
            faults.add(
                variable, "an unknown variable", listed([*variables, FILE_VARIABLE], variable)
            )
    return _Layer("environment", values, spell)


def _file(path: Path, faults: Faults) -> _Layer:
    try:
        tables = read_toml(read_input(path).decode("utf-8"))
    except UnicodeDecodeError as error:
        faults.add(f"{path}: byte {error.start}", "not UTF-8", "TOML is UTF-8 text")
        tables = {}
    except ValueError as error:  # no TOML
        faults.add(f"{path}: syntax", str(error), "TOML 1.0")
        tables = {}
    for name in tables:
        if name != "record":
            faults.add(f"{path}: {name}", "an unknown key", "one table, [record]")
    table = tables.get("record", {})
    if not isinstance(table, dict):
        faults.add(f"{path}: record", shown(table), "a table")
        table = {}
    values = cast("dict[str, object]", table)
    for name in values:
        if name not in PARSERS:
            faults.add(f"{path}: record.{name}", "an unknown key", listed(PARSERS, name))
    return _Layer(_origin(path), values, lambda name: f"{path}: record.{name}")


def _origin(file: Path) -> str:
    return str(file.absolute())  # no file has the name of another layer then


def _parsed(
    layer: _Layer, name: str, raw: object, parse: Callable[[object], Any], faults: Faults
) -> Any:
    """The value; None after a fault."""
    try:
        return parse(raw)
    except DataError as error:
        faults.add(layer.spell(name), _shown(raw), str(error))
        return None


def _check_together(given: Mapping[str, tuple[_Layer, object]], faults: Faults) -> None:
    """Check for missing settings and for those that exclude each other."""
    for name, valid in (
        ("sources", "at least one, e.g. can:socketcan:can0"),
        ("output", "a file, e.g. --output run.mcap"),
    ):
        if name not in given:
            faults.add(name, "nothing", valid)
    if "ring" not in given:
        return
    for name in ("split_size", "split_time"):
        if name in given:
            layer, raw = given[name]
            faults.add(
                layer.spell(name), _shown(raw), "leave it out: a ring writes only what is marked"
            )


def _shown(raw: object) -> str:
    if isinstance(raw, Path):
        return shown(str(raw))
    if isinstance(raw, tuple):
        return shown(list(cast("tuple[object, ...]", raw)))
    return shown(raw)


def _robot_file(file: Path, robot: str) -> str:
    """Return the robot's file beside the settings if it exists, else its name."""
    there = file.parent / robot
    return str(there) if is_file(there) else robot


def _timed(output: Path, now_ns: int) -> Path:
    start = datetime.fromtimestamp(now_ns // 1_000_000_000, UTC)
    return Path(os.fspath(output).replace("{time}", f"{start:%Y%m%dT%H%M%SZ}"))
