"""The layout: bodies overlaid on the left, plots of all and of the differences on the right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import rerun.blueprint as rrb
from rerun.encodings import EntityPathLike

from undulog.analysis.common.formats import short, utc
from undulog.analysis.results.comparison import Comparison, MetadataChange

from ..draw import lines
from ..draw import stage as ranges
from ..draw.body import COMMANDED, LABELS, MARKERS, MEASURED
from ..draw.drawing import FACTS as SESSION
from ..draw.drawing import code, document, escaped, listed
from ..draw.stage import TRAIL
from ..layout import bar_chart, blueprint, build_views, plot, tabs, trail_window
from ..samples.content import Content, PlottedSeries
from .draw import BARS, DIFFERENCES, LINES, POWER, ChartQuantity
from .sessions import COMPARED, Align, Side

FACTS = f"{COMPARED}/facts"

_CHANGES, _SENTENCE = 12, 200

_ALIGNED = {
    Align.TIME: "Aligned by the time since each session's first sample.",
    Align.GAIT: "Aligned by the time since the start of each session's gait.",
    Align.PHASE: "Aligned by the phase of the gait.",
}

SEPARATE = "/head_distance"
"""Distance of the heads, below a session's own path."""

_HIDDEN = (COMMANDED, MARKERS, LABELS, ranges.RANGES)  # what is drawn of the first body only


@dataclass(frozen=True)
class Found:
    """Result of a session's comparison with the first one.

    Attributes:
        comparison: Numbers, or None where there are none.
        changed: Metadata in which the two sessions differ.
    """

    comparison: Comparison | None
    why_not: str | None
    changed: tuple[MetadataChange, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """Omissions and limits of the comparison."""
        if self.comparison is None:
            return ()
        partial = self.comparison.partial
        left_out = () if partial is None else (short(partial, _SENTENCE),)
        return (*left_out, *self.comparison.warnings)


def answer(first: Side, other: Side, outcome: Found) -> str:
    """Return a comparison's answer with the sessions' names.

    Args:
        first: The first session, A.

    Returns:
        One sentence without its full stop.
    """
    result = outcome.why_not if outcome.comparison is None else outcome.comparison.answer
    return f"{other.name} (B) against {first.name} (A): {result}"


def markdown(
    sides: Sequence[Side],
    outcomes: Mapping[str, Found],
    how: Align,
    *,
    has_cycles: bool,
    legend: str,
    notes: Sequence[str],
) -> str:
    """Return the text that is shown beside the picture, as Markdown.

    Args:
        outcomes: Result of the comparison with the first session, by the others' names.
        has_cycles: Whether there is a timeline of gait cycles.
        legend: How the bodies differ in style.
        notes: How the bodies were placed, what is missing, what was assumed, a sentence each.
    """
    first, *others = sides
    parts = [f"**{escaped(answer(first, other, outcomes[other.name]))}.**" for other in others]
    parts.append(_table(sides))
    parts += [_changes(first, other, outcomes[other.name].changed) for other in others]
    if notes:
        parts.append(f"Placed and assumed:\n\n{listed(notes)}")
    cycles = "On `gait_cycle` one second is one cycle of the gait, for all sessions alike."
    parts.append(" ".join([_ALIGNED[how], legend, *([cycles] if has_cycles else [])]))
    return document(parts)


def _table(sides: Sequence[Side]) -> str:
    rows = ["| session | id | robot | lasts | recorded | verdict |", "|---|---|---|---|---|---|"]
    for side in sides:
        robot = "not described" if side.robot is None else side.robot.name
        lasts = f"{(side.end_ns - side.start_ns) * 1e-9:.1f} s"
        recorded, verdict = utc(side.start_ns), side.verdict or "none"
        rows.append(
            f"| {escaped(side.name)} | {code(side.session_id)} "
            f"| {robot}, {len(side.joints)} joints | {lasts} | {recorded} | {escaped(verdict)} |"
        )
    return "\n".join(rows)


def _changes(first: Side, other: Side, changed: Sequence[MetadataChange]) -> str:
    if not changed:
        return escaped(f"{other.name} is described as {first.name}: nothing was changed.")
    lines = [escaped(f"What was changed ({first.name}, then {other.name}):"), ""]
    for change in changed[:_CHANGES]:
        before, after = ("not set" if side is None else side for side in (change.a, change.b))
        lines.append("- " + escaped(f"{change.name}: {before} → {after}"))
    if len(changed) > _CHANGES:
        lines.append(f"- and {len(changed) - _CHANGES} more, which `undulog compare` lists")
    return "\n".join(lines)


@dataclass(frozen=True)
class SessionContent:
    """Content of a session in the recording.

    Attributes:
        content: Its own recording's.
        lines: Whether its head, middle or tail was measured.
        differences: Its angles minus the first session's; none of the first.
        apart: Whether the distance of its head from the first one's was written.
        bars: Quantities that differ from the first session's.
    """

    side: Side
    content: Content
    lines: bool
    differences: tuple[PlottedSeries, ...] = ()
    apart: bool = False
    bars: tuple[ChartQuantity, ...] = ()

    @property
    def body(self) -> bool:
        """Whether its body is drawn."""
        return self.content.start is not None


def build_blueprint(
    shown: Sequence[SessionContent], bars: Sequence[ChartQuantity], how: Align, title: str
) -> rrb.Blueprint:
    """Lay out the content of a side by side recording.

    Args:
        shown: What was written of each session, the first one first.
        bars: Quantities whose bars stand next to each other.
        how: What happens at once; decides which timeline it plays on.
        title: Name of the bodies' view, its legend.

    Returns:
        The blueprint; it opens playing.
    """
    differing = [
        rrb.Horizontal(*_bar_differences(session), name=session.side.name)
        for session in shown[1:]
        if session.bars
    ]
    charts = [bar_chart(bar.title, f"{BARS}/{bar.key}/**") for bar in bars]
    groups = (
        (_both(shown), 1.25),
        (_differences(shown), 1.0),
        ([rrb.Horizontal(*charts)] if charts else [], 1.0),
        (differing, 1.0),
    )
    rows = [tabs(group) for group, _ in groups if group]
    heights = [height for group, height in groups if group]
    words = tabs(_words(shown))
    root: rrb.Container
    if bodies := [session for session in shown if session.body]:
        left = rrb.Vertical(_scene(bodies, title), words, row_shares=[3.0, 1.5])
        right = rrb.Vertical(*rows, row_shares=heights)
        root = rrb.Horizontal(left, right, column_shares=[1.0, 1.0]) if rows else left
    else:
        root = rrb.Vertical(*rows, words, row_shares=[*heights, 1.4])
    panel = rrb.TimePanel(
        state="collapsed", timeline=how.timeline, play_state="playing", loop_mode="all"
    )
    return blueprint(root, panel)


def _scene(bodies: Sequence[SessionContent], title: str) -> rrb.Spatial3DView:
    """Return the first body's own view of the world, with all bodies in it."""
    first = bodies[0]
    scene = build_views(first.content).scene
    assert scene is not None  # noqa: S101 - its body is drawn
    looks = cast("dict[str, Any]", scene.properties)
    looks["EyeControls3D"].tracking_entity = f"{first.side.entity}{MEASURED}"
    overrides: dict[EntityPathLike, Any] = {
        f"{body.side.entity}{TRAIL}": trail_window() for body in bodies
    }
    for path in (f"{body.side.entity}{path}" for body in bodies[1:] for path in _HIDDEN):
        overrides[path] = rrb.EntityBehavior(visible=False)
    return rrb.Spatial3DView(
        name=title,
        origin="/",
        contents=[f"{body.side.entity}/world/**" for body in bodies],
        background=looks["Background"],
        line_grid=looks["LineGrid3D"],
        eye_controls=looks["EyeControls3D"],
        overrides=overrides,
    )


def _both(shown: Sequence[SessionContent]) -> list[rrb.View]:
    views: list[rrb.View] = []
    if any(session.lines for session in shown):
        views.append(plot("Head, middle, tail [°]", [f"{LINES}/**"]))
    if powers := [
        f"{session.side.entity}{POWER}" for session in shown if session.content.has_power
    ]:
        views.append(plot("Mechanical power [W]", powers))
    return views


def _differences(shown: Sequence[SessionContent]) -> list[rrb.View]:
    """Return a view for each plane and session, and one of the distance of the heads."""
    first, *others = shown
    views: list[rrb.View] = []
    for other in others:
        for view in build_views(Content(first.side.robot, measured=other.differences)).angles:
            plane = str(view.name).lower().replace("measured", "").strip()
            view.name = f"{other.side.name} − {first.side.name}, {plane}".replace(", [", " [")
            views.append(view)
    if apart := [f"{session.side.compared}{SEPARATE}" for session in others if session.apart]:
        views.append(plot("Heads apart [m]", apart))
    return views


def _bar_differences(session: SessionContent) -> list[rrb.View]:
    return [
        bar_chart(
            f"{session.side.name}: {q.difference}",
            f"{session.side.compared}{DIFFERENCES}/{q.key}/**",
        )
        for q in session.bars
    ]


def _words(shown: Sequence[SessionContent]) -> list[rrb.View]:
    views: list[rrb.View] = [rrb.TextDocumentView(name="Side by side", contents=[FACTS])]
    views += [
        rrb.TextDocumentView(name=session.side.name, contents=[f"{session.side.entity}{SESSION}"])
        for session in shown
    ]
    if events := [
        f"{session.side.entity}{lines.EVENTS}" for session in shown if session.content.has_events
    ]:
        views.append(rrb.TextLogView(name="Events", contents=events))
    return views
