"""Extras: the optional packages of undulog, and the command that installs them."""

from __future__ import annotations

import shlex
from importlib.metadata import PackageNotFoundError, requires

from packaging.requirements import Requirement

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
    try:
        lines = requires("undulog") or []
    except PackageNotFoundError:
        return {}
    found: dict[str, str] = {}
    for wanted in map(Requirement, lines):
        marker, wanted.marker = wanted.marker, None
        if marker is not None and marker.evaluate({"extra": extra}):
            found[wanted.name] = str(wanted)
    return found


def install_command(extra: str, missing: str = "") -> str:
    """Return the command that installs an extra into the environment that runs.

    It names the packages, not undulog, so it is the same wherever undulog came from.

    Args:
        missing: Package to be installed where the extra's own packages are unknown.
    """
    packages = extra_packages(extra).values() or [missing]
    return shlex.join(["pip", "install", *packages])
