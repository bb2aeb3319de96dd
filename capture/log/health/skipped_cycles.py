"""Cycles that a controller left out, by the evidence of the log's own counters.

A controller with fixed deadlines that leaves out a cycle leaves the same stamps as a loss
(:mod:`.gaps`). If the log proves that nothing was lost, the controller never issued the cycle:

- every source has a count of lost frames, and it is 0; no packet was unreadable and no connection
  came back;
- the sequence numbers of the commands' channel count its messages, and none is missing.

Then the gaps of the commands are the controller's, and so are those of other joints that have as
many gaps, the longest at the same time: a servo that is polled answers when it is asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from ...common.arrays import NS
from .bus_tally import SourceHealth
from .tallies import ChannelHealth, SeriesHealth, Timing


def with_skipped_cycles(
    series: Sequence[SeriesHealth],
    channels: Iterable[ChannelHealth],
    sources: Sequence[SourceHealth],
    commands: str,
) -> tuple[SeriesHealth, ...]:
    """Return the series, with the gaps of cycles that the controller left out as late ones.

    Args:
        series: All series of the session.
        channels: Its channels.
        sources: Counts of the recorder; empty if it has none, and then nothing is proved.
        commands: Topic of the commands.
    """
    counted = any(
        channel.topic == commands and channel.sequence.dropped == 0 for channel in channels
    )
    if not counted or not sources or not all(map(_is_whole, sources)):
        return tuple(series)
    skipped = [
        channel.timing for channel in series if channel.topic == commands and channel.timing.gaps
    ]
    return tuple(
        replace(channel, timing=_all_late(channel.timing))
        if any(_same_cycles(channel, timing, commands) for timing in skipped)
        else channel
        for channel in series
    )


def _is_whole(source: SourceHealth) -> bool:
    """Whether the counters of a source prove that nothing was lost."""
    return source.dropped == 0 and not source.malformed and not source.reconnects


def _same_cycles(series: SeriesHealth, skipped: Timing, commands: str) -> bool:
    """Whether the gaps of a series are those of the commands."""
    if series.topic == commands:
        return series.timing == skipped
    timing = series.timing
    ends = [rhythm.longest_at_ns + round(rhythm.longest_s * NS) for rhythm in (timing, skipped)]
    overlap = min(ends) - max(timing.longest_at_ns, skipped.longest_at_ns)
    shortest = min(timing.longest_s, skipped.longest_s) * NS
    return bool(series.names) and timing.gaps == skipped.gaps and 2 * overlap > shortest


def _all_late(timing: Timing) -> Timing:
    return replace(timing, missing=0, scattered=0, late=timing.gaps)
