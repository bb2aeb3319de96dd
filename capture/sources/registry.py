"""Finding a source by the scheme of its address, among the installed entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import cast

from ..common.errors import MissingExtraError, SourceError, UndulogError, UsageError
from ..common.strict_table import listed
from .address import parse_address
from .contract import ENTRY_POINTS, Source, SourceAddress

_EXTRAS = {"pybullet": "sim", "mujoco": "mujoco"}
"""Optional package of a source to the extra that installs it."""


def schemes() -> tuple[str, ...]:
    """The schemes that are installed, sorted."""
    return tuple(sorted(entry_points(group=ENTRY_POINTS).names))


def open_source(address: SourceAddress) -> Source:
    """Make the source that an address names; it is not started.

    Args:
        address: From :func:`.capture.sources.address.parse_address`.

    Returns:
        The source.

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
    """Make all the sources of a recording; none is started.

    Args:
        texts: Addresses as the command line has them.

    Returns:
        The sources, in that order.

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
