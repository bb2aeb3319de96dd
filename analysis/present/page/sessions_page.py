"""Several sessions on one page: an index with the first sentence of each, then their reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from undulog.capture import SessionView
from undulog.capture.commands.sessions import Line, first_sentence
from undulog.capture.common.errors import UsageError

from ...results.analysis import Analysis
from ...session.cycles import CycleMaps
from .page import LARGEST_BYTES, environment
from .session_view import session_view


@dataclass
class _Part:
    analysis: Analysis
    at: str
    html: str


class SessionsPage:
    """Collects sessions, one open at a time, and keeps within ``LARGEST_BYTES``.

    Where the page would grow larger, the samples and the cycles of all sessions are left out.
    """

    def __init__(self) -> None:
        """Start with no session."""
        self._parts: dict[Path, _Part] = {}
        self._left_out = False

    def add(
        self, path: Path, analysis: Analysis, session: SessionView, cycles: CycleMaps | None
    ) -> None:
        """Add a session that is still open."""
        at = f"s{len(self._parts) + 1}-"
        drawn = (None, None) if self._left_out else (session, cycles)
        self._parts[path] = _Part(analysis, at, self._rendered(analysis, at, *drawn))
        if self._bytes() > LARGEST_BYTES and not self._left_out:
            self._left_out = True
            for part in self._parts.values():
                part.html = self._rendered(part.analysis, part.at)

    def check_size(self) -> None:
        """Check whether the page is not too large yet, even without samples and cycles.

        Raises:
            UsageError: If it is.
        """
        if self._bytes() > LARGEST_BYTES:
            raise UsageError(
                f"{len(self._parts)} sessions make a page of more than {LARGEST_BYTES / 1e6:g} MB: "
                "put fewer on it, or give each a page of its own with -o FOLDER"
            )

    def render(self, lines: Sequence[tuple[Path, tuple[str, Line]]]) -> str:
        """Return the page.

        Args:
            lines: Path, name and line of every session; one that was not added has a line only.

        Raises:
            UsageError: If the page would be too large even without samples and cycles.
        """
        self.check_size()
        targets = {path: f"#{part.at}answer" for path, part in self._parts.items()}
        rows = [
            (name, line, targets.get(path), first_sentence(line.sentence))
            for path, (name, line) in lines
        ]
        parts = [
            (part.at, Markup(part.html))  # noqa: S704  rendered above
            for part in self._parts.values()
        ]
        return environment().get_template("sessions.html.j2").render(rows=rows, parts=parts)

    def _bytes(self) -> int:
        return sum(len(part.html.encode()) for part in self._parts.values())

    def _rendered(
        self,
        analysis: Analysis,
        at: str,
        session: SessionView | None = None,
        cycles: CycleMaps | None = None,
    ) -> str:
        view = session_view(analysis, session, cycles, at)
        template = environment().get_template("session_part.html.j2")
        return template.render(v=view, at=at, top=2, left_out=self._left_out)
