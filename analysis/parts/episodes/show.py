"""The table of the episodes, as lines and as rows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from undulog.capture.common.errors import some_names

from .result import EpisodeFault, EpisodesResult

MOST_LINES = 10
"""Faults that the text has: the rest is counted, and is in CSV and JSON."""

COLUMNS = ("episode", "fault", "joint", "times the limit", "what")


def rows_of(result: EpisodesResult) -> Iterator[tuple[str, ...]]:
    """Yield cells of :data:`COLUMNS` for the worst faults."""
    for fault in result.faults[:MOST_LINES]:
        kind = fault.kind
        if fault.not_decided:
            kind += f" or {fault.not_decided}"
        times = "" if fault.times is None else f"{fault.times:.1f}"
        yield str(fault.episode), kind, fault.joint or "all", times, fault.sentence


def heading(result: EpisodesResult) -> str:
    """Return the first line: the answer."""
    size = (
        f"{result.episodes} episode{'s' * (result.episodes != 1)} of {len(result.joints)} joints, "
        f"{result.frames / result.fps:.0f} s at {result.fps:g} Hz, angles in {result.unit}"
    )
    bad = len(result.leave_out)
    if not bad:
        return f"{result.name}: {size}; no episode stands out"
    return f"{result.name}: {size}; {bad} episode{'s' * (bad > 1)} stand{'s' * (bad == 1)} out"


def closing(result: EpisodesResult) -> Iterator[str]:
    """Yield what comes behind the table."""
    rest = result.faults[MOST_LINES:]
    if rest:
        others = {fault.episode for fault in rest}
        yield f"and {len(rest)} more in {len(others)} episodes (--csv, --json)"
    if result.leave_out:
        listed = str([*result.leave_out])
        yield f"leave out: {listed}"
        yield (
            "  lerobot-edit-dataset --repo_id REPO --operation.type delete_episodes "
            f'--operation.episode_indices "{listed}"'
        )
    if result.not_judged:
        numbers = [*result.not_judged]
        why = next(iter(result.not_judged.values()))
        yield f"not decided: episodes {some_names(numbers, 10)} ({why})"
    yield from (f"not decided: {limit}" for limit in result.limits)


def table_of(result: EpisodesResult) -> dict[str, list[Any]]:
    """Return all faults as columns."""
    return {
        "episode": [fault.episode for fault in result.faults],
        "kind": [fault.kind for fault in result.faults],
        "joint": [fault.joint for fault in result.faults],
        "size": [fault.size for fault in result.faults],
        "unit": [fault.unit for fault in result.faults],
        "size_low": [_end(fault, 0) for fault in result.faults],
        "size_high": [_end(fault, 1) for fault in result.faults],
        "times_limit": [_number(fault.times) for fault in result.faults],
        "at_s": [_number(fault.at_s) for fault in result.faults],
        "not_decided": [fault.not_decided for fault in result.faults],
        "sentence": [fault.sentence for fault in result.faults],
    }


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _end(fault: EpisodeFault, k: int) -> float:
    return float("nan") if fault.ci95 is None else fault.ci95[k]
