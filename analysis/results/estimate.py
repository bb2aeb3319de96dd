"""A value with its interval, and where a result comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Interval = tuple[float, float]


def leaves_out_zero(ci95: Interval | None) -> bool:
    """Return whether a value differs from zero beyond doubt.

    Args:
        ci95: Its 95 % interval, or None.

    Returns:
        False where there is no interval.
    """
    return ci95 is not None and (ci95[0] > 0 or ci95[1] < 0)


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval.

    Attributes:
        value: The estimate, or None where it could not be computed.
        ci95: Low and high end of the 95 % interval, or None.
    """

    value: float | None = None
    ci95: Interval | None = None


@dataclass(frozen=True)
class Provenance:
    """How the result was made, so that it can be made again.

    Attributes:
        command: The command line that makes it.
        inputs: Input file to SHA-256.
    """

    command: str
    versions: dict[str, str]
    inputs: dict[str, str]
    options: dict[str, Any]
