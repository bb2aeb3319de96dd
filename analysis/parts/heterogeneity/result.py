"""An index of heterogeneity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...common.estimate import WithInterval

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class Index(WithInterval):
    """One heterogeneity index, in ``unit``.

    Attributes:
        p: p-value of the index's null, or None where no test belongs to it.
        unit: SI unit, or ``1``.
        label: What it measures, in a few words.
    """

    p: float | None = None
    unit: str = "1"
    label: str = ""
