"""What every result can do besides holding numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from .picture import Picture


class Shown:
    """A result that prints, plots, becomes tables, and goes to files and back.

    The first line printed is the answer. ``frames`` gives the numbers as pandas tables whose
    columns carry their units; ``undulog.analysis.load`` reads what ``save`` wrote.
    """

    def __str__(self) -> str:
        """The result as text, the answer first."""
        from .text import text_of

        return text_of(self).rstrip("\n")

    def __repr__(self) -> str:
        """The answer in one line."""
        from undulog.capture.console import plain

        from .text import headline_of

        return f"<{type(self).__name__}: {plain(headline_of(self))}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: the answer, and the first table."""
        from .text import html_of

        return html_of(self)

    def frames(self) -> dict[str, pd.DataFrame]:
        """The numbers as tables.

        Returns:
            Name to table, the most telling first. Columns end in their unit (``lag_rad``), the ends
            of a 95 % interval are ``lag_low_rad`` and ``lag_high_rad``; what could not be computed
            is NaN.
        """
        from .frames import frames_of

        return frames_of(self)

    def plot(self, what: str | None = None) -> Picture:
        """The result as a picture, as the report draws it; needs the extra ``report``.

        Args:
            what: Which picture, where there are several; the first by default.

        Returns:
            A picture that a notebook shows and that ``save`` writes.

        Raises:
            UsageError: If there is no such picture; the message lists those that are.
            MissingExtraError: If matplotlib is not installed.
        """
        from .pictures import picture_of

        return picture_of(self, what)

    def save(self, path: Path | str, *, force: bool = False) -> Path:
        """Write the result to a JSON file, the same object that ``--json`` prints.

        Args:
            path: A name that ends in .json.
            force: Replace the file if it exists.

        Returns:
            The path.

        Raises:
            UsageError: If the name ends in anything else, or its folder doesn't exist.
            OutputExistsError: If it is there and ``force`` is not given.
            LogWriteError: If it can't be written.
        """
        from .files import save

        return save(self, Path(path), force=force)

    def to_parquet(self, folder: Path | str, *, force: bool = False) -> list[Path]:
        """Write every table to a Parquet file of its own; needs the extra ``parquet``.

        Args:
            folder: Made if it isn't there.
            force: Replace files that exist.

        Returns:
            The files, named after the tables.

        Raises:
            OutputExistsError: If one is there and ``force`` is not given.
            MissingExtraError: If pyarrow is not installed.
            LogWriteError: If one can't be written.
        """
        from .files import save_tables

        return save_tables(self, Path(folder), force=force)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain JSON values.

        Returns:
            A dictionary that ``json.dumps(..., allow_nan=False)`` takes.
        """
        import dataclasses

        return dataclasses.asdict(self)  # pyright: ignore[reportArgumentType]
