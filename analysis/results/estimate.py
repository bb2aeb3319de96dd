"""A value with its interval, and where a result comes from."""

from __future__ import annotations

import math
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
class WithInterval:
    """A value with its 95 % interval.

    Attributes:
        value: None where it could not be computed or isn't finite.
        ci95: Low and high end of the 95 % interval, or None where either isn't finite.
    """

    value: float | None = None
    ci95: Interval | None = None

    def __post_init__(self) -> None:
        """Replace what isn't finite, which JSON can't hold, by None."""
        if self.value is not None and not math.isfinite(self.value):
            object.__setattr__(self, "value", None)
        if self.ci95 is not None and not all(map(math.isfinite, self.ci95)):
            object.__setattr__(self, "ci95", None)


@dataclass(frozen=True)
class Estimate(WithInterval):
    """An estimate, in the unit that its name gives."""


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
