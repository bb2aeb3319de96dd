"""The layout, made for a laptop's 1440 x 900: a tab each for session, cycles and mean cycle.

In the session's the body is on the left and plots are on the right.
"""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from ..content.content import Content, Tab
from ..samples.timeline import ENSEMBLE_CYCLE, SESSION_TIME
from .views import Views, build_views


def build_blueprint(content: Content, front: Tab = "session") -> rrb.Blueprint:
    """Lay out the views of what a recording holds.

    Args:
        content: What it holds.
        front: The tab in front; the session's where the recording has no such tab. In front, the
            mean cycle plays on its own timeline.

    Returns:
        The blueprint, with the viewer's own panels folded away; it opens playing, or
        following the end of what still grows.
    """
    views = build_views(content)
    tabs: dict[Tab, rrb.Container] = {"session": _session(content, views)}
    if views.maps or views.steps:
        rows = [rrb.Horizontal(*row) for row in (views.maps, views.steps) if row]
        shares = [1.35, 1.0][: len(rows)]
        tabs["cycles"] = rrb.Vertical(*rows, row_shares=shares, name="Cycles")
    if views.mean_plots and views.mean_words is not None:
        tabs["mean-cycle"] = _mean(views, views.mean_words)
    shown: Tab = front if front in tabs else "session"
    root = tabs[shown]
    if len(tabs) > 1:
        root = rrb.Tabs(*tabs.values(), active_tab=list(tabs).index(shown))
    timeline = ENSEMBLE_CYCLE if shown == "mean-cycle" else SESSION_TIME
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        _time_panel(content, timeline),
        auto_views=False,
        auto_layout=False,
    )


def _session(content: Content, views: Views) -> rrb.Container:
    # A mode that never changes isn't worth a lane of its own.
    lane = [views.mode] if views.mode is not None and content.modes > 1 else []
    words = [*views.words, *([views.mode] if views.mode is not None and not lane else [])]
    plots: list[rrb.View | rrb.Container] = [
        _tabs(group) for group in (views.angles, views.effort) if group
    ]
    heights = [3.0, 2.4][: len(plots)]
    if views.bars:
        plots.append(rrb.Horizontal(*views.bars))
        heights.append(3.0)
    if views.scene is None:
        shares = [*heights, *[0.8] * len(lane), 2.0]
        return rrb.Vertical(*plots, *lane, _tabs(words), row_shares=shares, name="Session")
    shares = [3.2, *[0.62] * len(lane), 1.1]
    left = rrb.Vertical(views.scene, *lane, _tabs(words), row_shares=shares)
    right = rrb.Vertical(*plots, row_shares=heights)
    return rrb.Horizontal(left, right, column_shares=[1.1, 1.0], name="Session")


def _mean(views: Views, words: rrb.TextDocumentView) -> rrb.Container:
    first, *others = views.mean_plots
    plots = [first, _tabs(others)] if others else [first]
    right = rrb.Vertical(*plots)
    left = words
    if views.mean_scene is not None:
        left = rrb.Vertical(views.mean_scene, words, row_shares=[2.6, 1.0])
    return rrb.Horizontal(left, right, column_shares=[1.1, 1.0], name="Mean cycle")


def _time_panel(content: Content, timeline: str) -> rrb.TimePanel:
    if content.live:
        return rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following")
    return rrb.TimePanel(
        state="collapsed",
        timeline=timeline,
        play_state="playing",
        loop_mode="all",
        # The one timeline of numbers is that of the mean cycle's degrees: at the gait's own speed.
        fps=None if content.mean is None else 360.0 / content.mean.period_s,
    )


def _tabs(views: Sequence[rrb.View]) -> rrb.View | rrb.Tabs:
    return views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)
