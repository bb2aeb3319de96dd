"""Names and packages that are imported only when they are used.

Packages that another package imports at once and that hardly any run needs.

python-can imports asammdf wherever that is installed, and with it pandas and more: a second, and
70 MB in a recorder, for a format that one command reads. The command defers it; a program that uses
undulog as a library is left alone, since its own imports are not ours to change. cantools imports
python-can for its tester, which takes longer than reading a DBC file.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

DEFERRED = ("asammdf",)
"""Packages that are hidden until they are asked for."""

_ON_USE = ("cantools.tester",)
"""Modules that are imported when something of them is used."""

_hidden: set[str] = set()


class _ModuleOnUse(ModuleType):
    """Stands for a module until one of its names is used."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(import_module(self.__name__), name)


def defer() -> None:
    """Hide the packages from imports, unless they are imported already."""
    for name in DEFERRED:
        if name not in sys.modules:
            _hidden.add(name)
            sys.modules[name] = None  # pyright: ignore[reportArgumentType] importlib's own sign
    for name in _ON_USE:
        sys.modules.setdefault(name, _ModuleOnUse(name))


def undefer(name: str) -> None:
    """Make a package of :data:`DEFERRED` importable again."""
    if name in _hidden:
        _hidden.discard(name)
        del sys.modules[name]


def attach(package: str, modules: Mapping[str, str]) -> tuple[Callable[[str], Any], list[str]]:
    """Return ``__getattr__`` and ``__all__`` of a package whose names are defined in its modules.

    Args:
        package: Its ``__name__``.
        modules: Public name to the module that defines it, relative to the package.

    Raises:
        ImportError: If the package was not imported as ``undulog.<package>``. Under another name
            each of its modules, and each class in them, would exist twice.
    """
    if not package.startswith("undulog."):
        raise ImportError(f"import undulog.{package} instead of {package}", name=package)

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f".{modules[name]}", package), name)

    return get, sorted(modules)
