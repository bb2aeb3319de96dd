"""What a recorder says of itself once a second: the statuses of ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

LEVEL_NAMES = ("ok", "warn", "error", "stale")

NO_VALUES: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class DiagnosticStatus:
    """One component's state, as ``diagnostic_msgs/DiagnosticStatus`` has it.

    Attributes:
        level: :data:`OK`, :data:`WARN`, :data:`ERROR` or :data:`STALE`.
        name: The component, e.g. ``source can0``.
        message: One sentence.
        hardware_id: The device, e.g. ``can:socketcan:can0``; empty where there is none.
        values: Further facts; numbers as text.
    """

    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=lambda: NO_VALUES)
