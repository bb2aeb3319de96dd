"""Sources as the command line names them: ``[NAME=]SCHEME:REST[?KEY=VALUE&...]``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from importlib.metadata import EntryPoint, entry_points
from pathlib import PurePosixPath
from typing import cast

from ..common.errors import MissingExtraError, SourceError, UndulogError, UsageError
from ..common.strict_table import listed
from .contract import ENTRY_POINTS, Source, SourceAddress

_YES = {"1", "true", "yes", "on"}
_NO = {"0", "false", "no", "off"}


def only(address: SourceAddress, valid: Iterable[str]) -> None:
    """Check that an address has valid options only.

    Raises:
        UsageError: If it has another one; lists the valid ones.
    """
    names = sorted(valid)
    for key in address.options:
        if key not in names:
            raise UsageError(f"{address.text!r}: no option {key!r}; valid: {listed(names, key)}")


def number(address: SourceAddress, key: str, default: int) -> int:
    """Return an option that is a whole number, at least 0.

    Raises:
        UsageError: If it has another value.
    """
    value = address.options.get(key)
    if value is None:
        return default
    if not (value.isascii() and value.isdigit()):
        raise UsageError(f"{address.text!r}: {key}={value} is not a whole number")
    return int(value)


def flag(address: SourceAddress, key: str, *, default: bool) -> bool:
    """Return an option that is 1, true, yes or on, or 0, false, no or off.

    Raises:
        UsageError: If it has another value.
    """
    value = address.options.get(key)
    if value is None:
        return default
    if value.lower() not in _YES | _NO:
        raise UsageError(f"{address.text!r}: {key}={value} is neither 1 nor 0")
    return value.lower() in _YES


FORM = "[NAME=]SCHEME:REST[?KEY=VALUE&...]"
"""Form of an address, for messages."""

_EXAMPLES = "can:socketcan:can0, can:slcan:/dev/ttyACM0?bitrate=1000000, unix:/run/snake.sock"
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*")
_VALID_NAME = "a letter, then letters, digits and underscores, e.g. can0 or left_arm"
_PREFIX = re.compile(r"([^:?=]*)=(.*)", re.DOTALL)


def parse_address(text: str) -> SourceAddress:
    """Parse an address such as ``front=can:slcan:/dev/ttyACM0?bitrate=500000``.

    The default name is the last part of a CAN channel, the file of a socket, or the scenario.

    Raises:
        UsageError: If it isn't of that form, or the name can't be part of a topic.
    """
    named = _PREFIX.fullmatch(text)
    name, address = named.groups() if named else (None, text)
    place, _, query = address.partition("?")
    scheme, colon, rest = place.partition(":")
    if not colon or not scheme or not rest:
        raise UsageError(f"{text!r} is no source: expected {FORM}, e.g. {_EXAMPLES}")
    if name is None:
        name = _default_name(scheme, rest)
    elif not _NAME.fullmatch(name):
        raise UsageError(
            f"{text!r}: a source can't be called {name!r}, as the name becomes part of topics; "
            f"valid: {_VALID_NAME}"
        )
    return SourceAddress(text, name, scheme, rest, _options(text, query))


def _default_name(scheme: str, rest: str) -> str:
    """Return the name of a source without one: other characters become underscores.

    A name that would not begin with a letter gets the scheme before it.
    """
    if scheme == "can":
        last = PurePosixPath(rest.partition(":")[2]).name
    else:
        last = PurePosixPath(rest).stem
    name = re.sub(r"[^a-zA-Z0-9_]+", "_", last).strip("_")
    if _NAME.fullmatch(name):
        return name
    return re.sub(r"[^a-zA-Z0-9_]+", "_", scheme + name)


def _options(text: str, query: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for pair in query.split("&") if query else []:
        key, equals, value = pair.partition("=")
        if not key or not equals:
            raise UsageError(f"{text!r}: {pair!r} is no option; expected KEY=VALUE")
        if key in options:
            raise UsageError(f"{text!r}: the option {key} is given twice")
        options[key] = value
    return options


_EXTRAS = {"pybullet": "sim", "mujoco": "mujoco"}
"""Optional package of a source to the extra that installs it."""


def schemes() -> tuple[str, ...]:
    """Return the installed schemes, sorted."""
    return tuple(sorted(entry_points(group=ENTRY_POINTS).names))


def open_source(address: SourceAddress) -> Source:
    """Make the source of an address; it is not started.

    Raises:
        UsageError: If there is no such scheme or its options are wrong.
        MissingExtraError: If the scheme needs an extra that is not installed.
        SourceError: If it can never work here, or its plug-in fails.
    """
    found = entry_points(group=ENTRY_POINTS, name=address.scheme)
    if not found:
        valid = listed(schemes(), address.scheme)
        raise UsageError(f"{address.text!r}: no kind of source {address.scheme!r}; valid: {valid}")
    return _open(next(iter(found)), address)


def open_sources(texts: Iterable[str]) -> list[Source]:
    """Make the sources of a recording from their addresses; none is started.

    Raises:
        UsageError: If there is none, one is wrong, or two have one name.
        MissingExtraError: If one needs an extra that is not installed.
        SourceError: If one can never work here.
    """
    addresses = [parse_address(text) for text in texts]
    if not addresses:
        raise UsageError("no source given; e.g. can:socketcan:can0")
    first: dict[str, SourceAddress] = {}
    for address in addresses:
        if address.name in first:
            raise UsageError(
                f"{first[address.name].text!r} and {address.text!r} are both called "
                f"{address.name}; put another name before one, e.g. {address.name}_2=..."
            )
        first[address.name] = address
    return [open_source(address) for address in addresses]


def _open(entry: EntryPoint, address: SourceAddress) -> Source:
    try:
        return cast("Callable[[SourceAddress], Source]", entry.load())(address)
    except UndulogError:
        raise
    except Exception as error:
        missing = (getattr(error, "name", None) or "").split(".")[0]
        if isinstance(error, ModuleNotFoundError) and missing in _EXTRAS:
            raise MissingExtraError(address.text, _EXTRAS[missing], missing) from error
        fault = f"{entry.value} can't be opened: {error!r}"  # a plug-in, or the installation
        raise SourceError(address.text, fault) from error
