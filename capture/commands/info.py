"""Command ``info``: what is installed."""

from __future__ import annotations

import platform

from ..common.console import emit
from ..common.extras import (
    EXTRAS,
    base_versions,
    extra_packages,
    install_command,
    package_version,
)


def info(*, json: bool = False) -> None:
    """Show what is installed, for a bug report.

    Example: `undulog info --json`

    Args:
        json: Print one JSON object.
    """
    extras = {
        extra: {name: package_version(name) for name in extra_packages(extra)} for extra in EXTRAS
    }
    packages, system = base_versions(), platform.platform()
    lines = [
        f"undulog {packages['undulog']} on Python {packages['python']}, {system}",
        "packages  " + ", ".join(f"{k} {v}" for k, v in packages.items() if k != "undulog"),
    ]
    for extra, versions in extras.items():
        listed = ", ".join(f"{name} {number}" for name, number in versions.items())
        missing = f"not installed: {install_command(extra)}"
        lines.append(f"{extra:<9} {missing if None in versions.values() else listed}")
    emit({"platform": system, "packages": packages, "extras": extras}, lines, as_json=json)
