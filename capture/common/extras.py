"""Packages imported only when they are used, and the extras that bring the optional ones.

Packages that another package imports at once and that hardly any run needs.

python-can imports asammdf wherever that is installed, and with it pandas and more: a second, and
70 MB in a recorder, for a format that one command reads. The command defers it; a program that uses
undulog as a library is left alone, since its own imports are not ours to change. cantools imports
python-can for its tester, which takes longer than reading a DBC file.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.machinery import PathFinder
from types import ModuleType
from typing import Any

DEFERRED = ("asammdf",)
"""Packages that are hidden until they are asked for."""

_ON_USE = ("cantools.tester",)
"""Modules that are imported when something of them is used."""

_hidden: set[str] = set()

_BASE = ("undulog", "numpy", "scipy", "pandas", "mcap", "python-can", "cantools")
"""Packages whose versions go into results."""

EXTRAS = (
    *("sim", "mujoco", "numba", "replay", "report", "parquet", "mf4", "bags", "serial"),
    *("remote", "cluster", "catalog"),
)
"""Every extra of ``pyproject.toml`` but ``all``, which is all of them."""

_OF_MODULE = {
    "pybullet": "sim",
    "tomlkit": "sim",
    "mujoco": "mujoco",
    "numba": "numba",
    "rerun": "replay",
    "jinja2": "report",
    "markupsafe": "report",
    "matplotlib": "report",
    "asammdf": "mf4",
    "distributed": "cluster",
    "pyarrow": "parquet",
    "duckdb": "catalog",
    "obstore": "remote",
    "statsmodels": "catalog",
}
"""Optional module to the extra that installs it."""


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


def is_installed(name: str) -> bool:
    """Return whether a package could be imported; it isn't."""
    if name in sys.modules and name not in _hidden:
        return sys.modules[name] is not None  # pyright: ignore[reportUnnecessaryComparison]
    return PathFinder.find_spec(name) is not None


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


def missing_package(error: BaseException) -> str | None:
    """Return the optional module whose import failed, or None if it was another one."""
    cause: BaseException | None = error
    while cause is not None:
        name = (getattr(cause, "name", None) or "").partition(".")[0]
        if isinstance(cause, ImportError) and name in _OF_MODULE:
            return name
        cause = cause.__cause__
    return None


def extra_of(package: str, command: str = "") -> str:
    """Return the extra that installs a module.

    Args:
        package: One that :func:`missing_package` returns.
        command: The command that needs it; an extra of its name comes first.
    """
    return command if package in extra_packages(command) else _OF_MODULE[package]


def extra_packages(extra: str) -> dict[str, str]:
    """Return the packages of an extra that this Python and machine need.

    Returns:
        Name to requirement (``rerun-sdk`` to ``rerun-sdk<0.42,>=0.41``); empty if undulog is not
        installed as a package.
    """
    from importlib.metadata import PackageNotFoundError, requires

    from packaging.requirements import Requirement

    try:
        lines = requires("undulog") or []
    except PackageNotFoundError:
        return {}
    packages: dict[str, str] = {}
    for requirement in map(Requirement, lines):
        marker, requirement.marker = requirement.marker, None
        if marker is not None and marker.evaluate({"extra": extra}):
            packages[requirement.name] = str(requirement)
    return packages


def install_command(extra: str, missing: str = "") -> str:
    """Return the command that installs an extra into the environment that runs.

    It names the packages, not undulog, so it is the same wherever undulog came from.

    Args:
        missing: Package to be installed where the extra's own packages are unknown.
    """
    packages = extra_packages(extra).values() or [missing]
    return shlex.join(["pip", "install", *packages])


def package_version(name: str) -> str | None:
    """Return the version of a package, None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None


def base_versions() -> dict[str, str]:
    """Return the versions of Python and the packages that every result depends on."""
    import platform

    versions = {name: package_version(name) for name in _BASE}
    return {"python": platform.python_version()} | {k: v for k, v in versions.items() if v}
