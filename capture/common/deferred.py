"""Packages that another package imports at once and that hardly any run needs.

python-can imports asammdf wherever that is installed, and with it pandas and more: a second, and
70 MB in a recorder, for a format that one verb reads. The command defers it; a program that uses
undulog as a library is left alone, since its own imports are not ours to change.
"""

from __future__ import annotations

import sys

DEFERRED = ("asammdf",)

_hidden: set[str] = set()


def defer() -> None:
    """Have the packages look as if they were not installed, unless they are imported already."""
    for name in DEFERRED:
        if name not in sys.modules:
            _hidden.add(name)
            sys.modules[name] = None  # pyright: ignore[reportArgumentType] importlib's own sign


def undefer(name: str) -> None:
    """Make a package importable again, for whoever needs it.

    Args:
        name: One of :data:`DEFERRED`.
    """
    if name in _hidden:
        _hidden.discard(name)
        del sys.modules[name]
