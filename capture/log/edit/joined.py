"""What was found on several channels and joints at once, as one finding.

A lost bus cycle is missing in every joint and on every topic that came with it: that is one reason,
not one for each of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_MOST_LISTED = 8


@dataclass(frozen=True)
class Finding:
    """Something that was found.

    Attributes:
        weight: Index into :data:`.VERDICTS`; 0 is worth knowing and no fault.
        sentence: What, where, how much.
    """

    weight: int
    sentence: str


@dataclass(frozen=True)
class Fault:
    """Something that was found on one channel, or on one joint of it.

    Attributes:
        weight: As a finding has it.
        topic: Where; the topic, or a label that begins with it.
        name: The joint; empty for all that the topic carries.
        text: What, how much.
        gaps: How many gaps it is about; 0 if it is about something else.
        lost_ns: Begin and end of the longest of these gaps [Unix ns].
        part: Share of the samples that are missing in them.
    """

    weight: int
    topic: str
    name: str
    text: str
    gaps: int = 0
    lost_ns: tuple[int, int] = (0, 0)
    part: float = 0.0


def joined(faults: Iterable[Fault]) -> list[Finding]:
    """Join the faults of several channels and joints that are one.

    Of one text, and of gaps as many of each whose longest lie at one time, one finding names all
    channels and joints; of gaps it has the figures of where most is missing.

    Args:
        faults: In the order in which they are to be named.

    Returns:
        The findings, in the order of the first fault of each.
    """
    groups: list[list[Fault]] = []
    by_text: dict[tuple[int, str], list[Fault]] = {}
    for fault in faults:
        if fault.gaps:
            group = next((known for known in groups if _one_loss(known[0], fault)), None)
        else:
            group = by_text.get((fault.weight, fault.text))
        if group is not None:
            group.append(fault)
            continue
        groups.append([fault])
        if not fault.gaps:
            by_text[fault.weight, fault.text] = groups[-1]
    return [_finding(group) for group in groups]


def _one_loss(one: Fault, other: Fault) -> bool:
    """Whether the gaps of two channels are those of one loss: as many, the longest overlap."""
    if not one.gaps or (one.weight, one.gaps) != (other.weight, other.gaps):
        return False
    (begin, end), (start, stop) = one.lost_ns, other.lost_ns
    return 2 * (min(end, stop) - max(begin, start)) > min(end - begin, stop - start)


def _finding(group: Sequence[Fault]) -> Finding:
    worst = max(group, key=lambda fault: fault.part)
    where = _where(group)
    if len(group) == 1:
        return Finding(worst.weight, f"{where}: {worst.text}")
    each = "lost together: at most" if worst.gaps else "each:"
    return Finding(worst.weight, f"{where}, {each} {worst.text}")


def _where(group: Sequence[Fault]) -> str:
    """The channels and joints: topics of the same joints together."""
    names: dict[str, list[str]] = {}
    for fault in group:
        names.setdefault(fault.topic, []).append(fault.name)
    topics: dict[tuple[str, ...], list[str]] = {}
    for topic, found in names.items():
        topics.setdefault(tuple(found), []).append(topic)
    parts: list[str] = []
    for found, where in topics.items():
        label = listed(where)
        if found != ("",):
            label += f", {listed(found)}"
        parts.append(label)
    return "; ".join(parts)


def listed(names: Sequence[str], most: int = _MOST_LISTED) -> str:
    """Return a list as text.

    Args:
        names: What is listed.
        most: How many are named.

    Returns:
        E.g. ``a, b and c`` or ``a, b and 7 more``.
    """
    if len(names) > most:
        return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
