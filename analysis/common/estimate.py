"""What results are made of: values with intervals, where they come from, how they are presented."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import pandas as pd

Interval = tuple[float, float]


_make: list[Callable[[], Any]] = []


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


class PictureProtocol(Protocol):
    """A figure, as :class:`.analysis.Picture`."""

    @property
    def svg(self) -> str: ...  # noqa: D102
    @property
    def caption(self) -> str: ...  # noqa: D102
    def to_svg(self) -> str: ...  # noqa: D102
    def save(self, path: Path | str, *, force: bool = False) -> Path: ...  # noqa: D102


def present_with(make: Callable[[], Any]) -> None:
    """Set what presents results.

    Args:
        make: Called when a result is first printed, drawn or saved.
    """
    _make[:] = [make]


def _presentation() -> Any:
    return _make[0]()


class PresentedResult:
    """A result that prints, plots, becomes tables, and goes to files and back.

    The first line printed is the answer. ``frames`` gives the numbers as pandas tables whose
    columns carry their units; ``undulog.analysis.load`` reads what ``save`` wrote.
    """

    def __str__(self) -> str:
        """Return the result as text, the answer first."""
        return _presentation().text(self).rstrip("\n")

    def __repr__(self) -> str:
        """Return the answer in one line."""
        from undulog.capture.common.console import plain

        return f"<{type(self).__name__}: {plain(_presentation().headline(self))}>"

    def _repr_html_(self) -> str:
        """Return the answer and the first table for a notebook."""
        return _presentation().html(self)

    def frames(self) -> dict[str, pd.DataFrame]:
        """Return the numbers as tables.

        Returns:
            Name to table, the most telling first. Columns end in their unit (``lag_rad``), the ends
            of a 95 % interval are ``lag_low_rad`` and ``lag_high_rad``; what could not be computed
            is NaN.
        """
        return _presentation().frames(self)

    def plot(self, what: str | None = None) -> PictureProtocol:
        """Draw the result as in the report; needs the extra ``report``.

        Args:
            what: Which picture, where there are several; the first by default.

        Returns:
            A picture that a notebook shows and that ``save`` writes.

        Raises:
            UsageError: If there is no such picture; the message lists those that are.
            MissingExtraError: If matplotlib is not installed.
        """
        return _presentation().picture(self, what)

    def save(self, path: Path | str, *, force: bool = False) -> Path:
        """Write the result to a JSON file, the same object that ``--json`` prints.

        Args:
            path: A name that ends in .json.
            force: Replace the file if it exists.

        Raises:
            UsageError: If the name ends in anything else, or its folder doesn't exist.
            OutputExistsError: If it is there and ``force`` is not given.
            LogWriteError: If it can't be written.
        """
        return _presentation().save(self, Path(path), force=force)

    def to_parquet(self, folder: Path | str, *, force: bool = False) -> list[Path]:
        """Write every table to a Parquet file of its own; needs the extra ``parquet``.

        Args:
            folder: Made if it isn't there.

        Returns:
            The files, named after the tables.

        Raises:
            OutputExistsError: If one is there and ``force`` is not given.
            MissingExtraError: If pyarrow is not installed.
            LogWriteError: If one can't be written.
        """
        return _presentation().save_tables(self, Path(folder), force=force)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain JSON values.

        Returns:
            A dictionary that ``json.dumps(..., allow_nan=False)`` takes.
        """
        import dataclasses

        return dataclasses.asdict(self)  # pyright: ignore[reportArgumentType]
