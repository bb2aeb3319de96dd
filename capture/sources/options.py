"""The options of a source's address, each checked, none ignored."""

from __future__ import annotations

from collections.abc import Iterable

from ..common.errors import UsageError
from ..common.strict_table import listed
from .contract import SourceAddress

_YES = {"1", "true", "yes", "on"}
_NO = {"0", "false", "no", "off"}


def only(address: SourceAddress, valid: Iterable[str]) -> None:
    """See that there are no other options than these.

    Args:
        address: The address.
        valid: Names of the options.

    Raises:
        UsageError: If there is another one; lists those that are valid.
    """
    names = sorted(valid)
    for key in address.options:
        if key not in names:
            raise UsageError(f"{address.text!r}: no option {key!r}; valid: {listed(names, key)}")


def number(address: SourceAddress, key: str, default: int) -> int:
    """A whole number.

    Args:
        address: The address.
        key: Name of the option.
        default: If it isn't given.

    Returns:
        The number, not negative.

    Raises:
        UsageError: If it is something else.
    """
    value = address.options.get(key)
    if value is None:
        return default
    if not (value.isascii() and value.isdigit()):
        raise UsageError(f"{address.text!r}: {key}={value} is not a whole number")
    return int(value)


def flag(address: SourceAddress, key: str, *, default: bool) -> bool:
    """Yes or no.

    Args:
        address: The address.
        key: Name of the option.
        default: If it isn't given.

    Returns:
        True for 1, true, yes and on; False for 0, false, no and off.

    Raises:
        UsageError: If it is something else.
    """
    value = address.options.get(key)
    if value is None:
        return default
    if value.lower() not in _YES | _NO:
        raise UsageError(f"{address.text!r}: {key}={value} is neither 1 nor 0")
    return value.lower() in _YES
