"""Objects that other packages add by entry points."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points

from .errors import UsageError


def added_objects(group: str, noun: str) -> Iterator[tuple[str, str, object]]:
    """Load what other packages add, in the order of their names.

    Args:
        group: Of the entry points, e.g. ``undulog.parts``.
        noun: What each is, for errors, e.g. ``part``.

    Yields:
        Name of the entry point, how errors name it, and the object.

    Raises:
        UsageError: If one can't be loaded.
    """
    for point in sorted(entry_points(group=group), key=lambda point: point.name):
        label = f"the {noun} {point.name!r} ({point.value})"
        try:
            loaded: object = point.load()
        except Exception as error:
            raise UsageError(f"{label} can't be loaded: {error}; remove its package") from error
        yield point.name, label, loaded
