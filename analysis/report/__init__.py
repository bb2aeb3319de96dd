"""The offline report: one self-contained HTML page that answers first and proves after.

::

    from undulog.capture import Session
    from undulog.analysis.report import render

    with Session.open("run.mcap") as session:
        page = render(analysis, session)  # one page; a sequence of both for several sessions

It needs the extra ``report``; names are imported on first use, so that the command line starts
without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .page import render

__all__ = ["render"]


def __getattr__(name: str) -> Any:
    """Import ``render`` on first use."""
    if name != "render":
        raise AttributeError(f"module 'undulog.analysis.report' has no attribute {name!r}")
    from .page import render

    return render
