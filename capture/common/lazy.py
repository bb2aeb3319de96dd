"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


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
