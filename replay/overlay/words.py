"""What is seen side by side, in words: the answers first, how it was drawn last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from undulog.analysis.compare.changes import changes
from undulog.analysis.results.comparison import Change, Comparison
from undulog.analysis.results.formats import short, utc

from ..draw.facts import code, escaped
from .alignment import Align
from .side import COMPARED, Side

FACTS = f"{COMPARED}/facts"

_CHANGES, _SENTENCE = 12, 200

_ALIGNED = {
    Align.TIME: "Aligned by the time since each session's first sample.",
    Align.GAIT: "Aligned by the time since the start of each session's gait.",
    Align.PHASE: "Aligned by the phase of the gait.",
}


@dataclass(frozen=True)
class Found:
    """What a session's comparison with the first one says.

    Attributes:
        comparison: Numbers, or None where there are none.
        why_not: Why there are none.
        changed: What the two sessions say of themselves, and say otherwise.
    """

    comparison: Comparison | None
    why_not: str | None
    changed: tuple[Change, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What the comparison leaves out and what its intervals don't know."""
        if self.comparison is None:
            return ()
        partial = self.comparison.partial
        left_out = () if partial is None else (short(partial, _SENTENCE),)
        return (*left_out, *self.comparison.warnings)


def answer(first: Side, other: Side, found: Found) -> str:
    """A comparison's answer with the sessions' names.

    Args:
        first: The first session, A.
        other: The other one, B.
        found: Their comparison.

    Returns:
        One sentence without its full stop.
    """
    told = found.why_not if found.comparison is None else found.comparison.answer
    return f"{other.name} (B) against {first.name} (A): {told}"


def changed_between(first: Side, other: Side) -> tuple[Change, ...]:
    """What two sessions say of how they were made, and say otherwise.

    Args:
        first: Side A.
        other: Side B.

    Returns:
        The changes.
    """
    return changes([first.facts], [other.facts])


def markdown(
    sides: Sequence[Side],
    found: Mapping[str, Found],
    how: Align,
    *,
    has_cycles: bool,
    legend: str,
    notes: Sequence[str],
) -> str:
    """What a reader needs beside the picture.

    Args:
        sides: The sessions.
        found: What the comparison with the first says, by the others' names.
        how: What happens at once.
        has_cycles: Whether there is a timeline of gait cycles.
        legend: How the bodies are told apart.
        notes: How the bodies were placed, what is missing, what was assumed, a sentence each.

    Returns:
        Markdown.
    """
    first, *others = sides
    parts = [f"**{escaped(answer(first, other, found[other.name]))}.**" for other in others]
    parts.append(_table(sides))
    parts += [_changes(first, other, found[other.name].changed) for other in others]
    told = dict.fromkeys(notes)
    if told:
        parts.append(
            "\n".join(["Placed and assumed:", "", *(f"- {escaped(note)}" for note in told)])
        )
    drawn = [_ALIGNED[how], legend]
    if has_cycles:
        drawn.append("On `gait_cycle` one second is one cycle of the gait, for all sessions alike.")
    parts.append(" ".join(drawn))
    return "\n\n".join(parts) + "\n"


def _table(sides: Sequence[Side]) -> str:
    rows = [
        "| session | id | robot | lasts | recorded | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for side in sides:
        robot = "not described" if side.robot is None else side.robot.name
        lasts = f"{(side.end_ns - side.start_ns) * 1e-9:.1f} s"
        recorded, verdict = utc(side.start_ns), side.verdict or "none"
        rows.append(
            f"| {escaped(side.name)} | {code(side.session_id)} "
            f"| {robot}, {len(side.joints)} joints | {lasts} | {recorded} | {escaped(verdict)} |"
        )
    return "\n".join(rows)


def _changes(first: Side, other: Side, changed: Sequence[Change]) -> str:
    if not changed:
        said = f"{other.name} says of itself what {first.name} does: nothing was changed."
        return escaped(said)
    lines = [escaped(f"What was changed ({first.name}, then {other.name}):"), ""]
    for one in changed[:_CHANGES]:
        before, after = ("not set" if side is None else side for side in (one.a, one.b))
        lines.append("- " + escaped(f"{one.name}: {before} → {after}"))
    if len(changed) > _CHANGES:
        lines.append(f"- and {len(changed) - _CHANGES} more, which `undulog compare` lists")
    return "\n".join(lines)
