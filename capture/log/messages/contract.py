"""Version of the log contract: what is written, and what can be read."""

from __future__ import annotations

from collections.abc import Mapping

CONTRACT_VERSION = 1
"""Version that sessions are written by.

It goes up when a reader of the version before would take a new file for something else. A new
topic, record or entry leaves it: earlier readers ignore it. Every earlier version is read.
"""


def newer_contract(facts: Mapping[str, str]) -> str | None:
    """Return a warning if a session follows a version that is not known here, else None.

    Args:
        facts: The metadata record ``undulog``.
    """
    stated = facts.get("contract", "")
    if not (stated.isascii() and stated.isdigit()) or int(stated[:9]) <= CONTRACT_VERSION:
        return None
    return (
        f"it follows version {stated[:9]} of the log contract, and this undulog reads up to "
        f"{CONTRACT_VERSION}: what has changed since may be misread; update undulog"
    )
