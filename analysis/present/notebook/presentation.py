"""The presentation of results: text, HTML, tables, pictures, files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from ...results.shown import Shown
    from .pictures import Picture


class Presenter:
    """A :class:`.Presentation`; each method imports what it needs when called."""

    def text(self, result: Shown) -> str:  # noqa: D102
        from .text import text_of

        return text_of(result)

    def headline(self, result: Shown) -> str:  # noqa: D102
        from .text import headline_of

        return headline_of(result)

    def html(self, result: Shown) -> str:  # noqa: D102
        from .text import html_of

        return html_of(result)

    def frames(self, result: Shown) -> dict[str, pd.DataFrame]:  # noqa: D102
        from .frames import frames_of

        return frames_of(result)

    def picture(self, result: Shown, what: str | None) -> Picture:  # noqa: D102
        from .pictures import picture_of

        return picture_of(result, what)

    def save(self, result: Shown, path: Path, *, force: bool) -> Path:  # noqa: D102
        from .files import save

        return save(result, path, force=force)

    def save_tables(self, result: Shown, folder: Path, *, force: bool) -> list[Path]:  # noqa: D102
        from .files import save_tables

        return save_tables(result, folder, force=force)
