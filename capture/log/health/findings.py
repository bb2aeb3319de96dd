"""What the health check finds: faults of channels and joints, joined to findings in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_MOST_LISTED = 8

WAITS_FOR_COMMANDS = "waiting for commands"
"""State of a session of a robot that reports its joints and has had no command yet."""


@dataclass(frozen=True)
class Finding:
    """A finding of the health check.

    Attributes:
        weight: Index into :data:`VERDICTS`; 0 is a note and no fault.
    """

    weight: int
    sentence: str


WAITING = Finding(0, f"{WAITS_FOR_COMMANDS}: the robot reports its joints, and none has come")
"""A fact about the controller and no fault of the record."""


@dataclass(frozen=True)
class ChannelFault:
    """A fault of one channel, or of one joint of it.

    Attributes:
        weight: See :class:`Finding`.
        topic: The topic, or a label that begins with it.
        name: The joint; empty for all joints of the topic.
        gaps: Number of gaps; 0 for a fault of another kind.
        lost_ns: Begin and end of the longest gap [Unix ns].
        part: Share of the samples that are missing in the gaps.
        late: Whether the gaps are late cycles, in which nothing is missing.
    """

    weight: int
    topic: str
    name: str
    text: str
    gaps: int = 0
    lost_ns: tuple[int, int] = (0, 0)
    part: float = 0.0
    late: bool = False


def joined(faults: Iterable[ChannelFault]) -> list[Finding]:
    """Join equal faults of several channels and joints to one finding each.

    A lost bus cycle, for instance, is missing in every joint and on every topic of the cycle.
    Faults of the same text are joined, and gaps of the same number whose longest ones overlap; the
    figures of joined gaps are those of the channel with the most missing samples.

    Args:
        faults: In the order in which they are named.

    Returns:
        The findings, in the order of the first fault of each.
    """
    groups: list[list[ChannelFault]] = []
    by_text: dict[tuple[int, str], list[ChannelFault]] = {}
    for fault in faults:
        if fault.gaps:
            matches = (group for group in groups if _one_loss(group[0], fault))
            group = next(matches, list[ChannelFault]())
        else:
            group = by_text.setdefault((fault.weight, fault.text), [])
        if not group:
            groups.append(group)
        group.append(fault)
    return [_finding(group) for group in groups]


def _one_loss(fault: ChannelFault, other: ChannelFault) -> bool:
    """Whether the gaps of two channels are of one loss: equal in number, the longest overlap."""
    if not fault.gaps or (fault.weight, fault.gaps, fault.late) != (
        other.weight,
        other.gaps,
        other.late,
    ):
        return False
    (begin, end), (start, stop) = fault.lost_ns, other.lost_ns
    return 2 * (min(end, stop) - max(begin, start)) > min(end - begin, stop - start)


def _finding(group: Sequence[ChannelFault]) -> Finding:
    worst = max(group, key=lambda fault: fault.part)
    where = _where(group)
    if len(group) == 1:
        return Finding(worst.weight, f"{where}: {worst.text}")
    extent = f"{'late' if worst.late else 'lost'} together: at most" if worst.gaps else "each:"
    return Finding(worst.weight, f"{where}, {extent} {worst.text}")


def _where(group: Sequence[ChannelFault]) -> str:
    """Name the channels and joints; topics of the same joints together."""
    names: dict[str, list[str]] = {}
    for fault in group:
        names.setdefault(fault.topic, []).append(fault.name)
    topics: dict[tuple[str, ...], list[str]] = {}
    for topic, name in names.items():
        topics.setdefault(tuple(name), []).append(topic)
    return "; ".join(
        listed(where) + ("" if joints == ("",) else f", {listed(joints)}")
        for joints, where in topics.items()
    )


def listed(names: Sequence[str], most: int = _MOST_LISTED) -> str:
    """Return a list as text, e.g. ``a, b and c`` or ``a, b and 7 more``."""
    if len(names) > most:
        return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
