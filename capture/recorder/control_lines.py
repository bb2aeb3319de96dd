"""Lines of the control socket: JSON requests in, JSON replies out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

Reply = Mapping[str, Any]

BUFFER = 64 * 1024
"""Longest request, and the most replies that wait for a client that doesn't read [B]."""

TOO_LONG = f"a request is longer than {BUFFER} bytes"


def read_request(line: bytes) -> dict[str, Any] | str:
    """Read one line.

    Args:
        line: With or without its newline.

    Returns:
        The request, or what is wrong with the line.
    """
    if len(line) > BUFFER:
        return TOO_LONG
    try:
        request = json.loads(line, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        return f"not JSON: {error}"
    if not isinstance(request, dict):
        return 'a request is a JSON object such as {"do": "status"}'
    return cast("dict[str, Any]", request)


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def reply_line(reply: Reply) -> bytes:
    """Write one line.

    Args:
        reply: Plain JSON values.

    Returns:
        The line, its newline at the end.

    Raises:
        ValueError: If it has a number that JSON doesn't have.
        TypeError: If it has a value that JSON doesn't have.
    """
    return json.dumps(reply, allow_nan=False).encode() + b"\n"


def refusal(error: str) -> bytes:
    """The reply to what can't be done.

    Args:
        error: Why.

    Returns:
        The line.
    """
    return reply_line({"ok": False, "error": error})
