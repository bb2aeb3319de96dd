"""Connections of a recording's sources, and what they mean for its end.

A recording of a robot that was never there has a whole file, but did not do what it was started
for: it ends as failed (exit code 1), and its report gives the source and the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..sources.contract import ConnectedSource, EndingSource, Polled, Source

_NO_REASON = "no attempt to connect has ended"


@dataclass
class SourceLink:
    """The connection of one source, as the loop sees it at each poll.

    Attributes:
        listens: Whether its senders connect to it.
        ever_connected: Whether it was connected at a poll, or gave a frame. A sender that connects
            and leaves between two polls without a frame does not count.
        lost: Whether the connection broke, and has not come back.
        latest: Its latest event: without a connection, the reason.
    """

    listens: bool
    ever_connected: bool = False
    lost: bool = False
    latest: str = ""

    def note(self, source: Source, polled: Polled) -> None:
        """Take what a poll returned."""
        if polled.events:
            self.latest = polled.events[-1].text
        self.lost = isinstance(source, ConnectedSource) and source.lost
        self.ever_connected = self.ever_connected or source.connected or source.counts.frames > 0


def links_of(sources: Iterable[Source]) -> dict[str, SourceLink]:
    """Return the link of each source by its name, before the first poll."""
    return {source.name: SourceLink(isinstance(source, EndingSource)) for source in sources}


def link_faults(links: Mapping[str, SourceLink]) -> tuple[str, ...]:
    """Return the faults of links that make a recording a failed one, a sentence each.

    Args:
        links: The links at the end of the recording, by the source's name.

    Returns:
        A sentence for each source that was never connected during the whole recording, or whose
        connection was lost and is not back.
    """
    never = tuple(
        f"source {name} was never connected: {link.latest or _NO_REASON}"
        + (", and no sender came" if link.listens else "")
        for name, link in links.items()
        if not link.ever_connected
    )
    lost = tuple(
        f"source {name} is not connected any more: {link.latest}"
        for name, link in links.items()
        if link.lost
    )
    return never + lost
