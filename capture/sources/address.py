"""Sources as the command line names them: ``[NAME=]SCHEME:REST[?KEY=VALUE&...]``."""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from ..common.errors import UsageError
from .contract import SourceAddress

FORM = "[NAME=]SCHEME:REST[?KEY=VALUE&...]"
"""What an address looks like, for messages."""

_EXAMPLES = "can:socketcan:can0, can:slcan:/dev/ttyACM0?bitrate=1000000, unix:/run/snake.sock"
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*")
_VALID_NAME = "a letter, then letters, digits and underscores, e.g. can0 or left_arm"
_PREFIX = re.compile(r"([^:?=]*)=(.*)", re.DOTALL)


def parse_address(text: str) -> SourceAddress:
    """Take an address apart.

    Without a name, the source is called after what it is connected to: a CAN bus after the last
    piece of its channel, a socket after its file, what brings its own robot after its scenario.

    Args:
        text: E.g. ``front=can:slcan:/dev/ttyACM0?bitrate=500000``.

    Returns:
        The address; nothing is opened or looked up.

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
        name = default_name(scheme, rest)
    elif not _NAME.fullmatch(name):
        raise UsageError(
            f"{text!r}: a source can't be called {name!r}, as the name becomes part of topics; "
            f"valid: {_VALID_NAME}"
        )
    return SourceAddress(text, name, scheme, rest, _options(text, query))


def default_name(scheme: str, rest: str) -> str:
    """What a source is called that was given no name.

    Args:
        scheme: E.g. ``can``.
        rest: E.g. ``socketcan:can0``.

    Returns:
        A valid name: what can't be part of one becomes an underscore, and a name that would begin
        with something else than a letter gets the scheme before it.
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
