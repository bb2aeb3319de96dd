"""The layout: body on the left, plots on the right, made for a laptop's 1440 x 900."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from .content import Content
from .timeline import SESSION_TIME
from .views import build_views


def build_blueprint(content: Content) -> rrb.Blueprint:
    """Lay out the views of what a recording holds.

    Args:
        content: What it holds.

    Returns:
        The blueprint, with the viewer's own panels folded away; it opens playing, or
        following the end of what still grows.
    """
    views = build_views(content)
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
    root: rrb.Container
    if views.scene is None:
        shares = [*heights, *[0.8] * len(lane), 2.0]
        root = rrb.Vertical(*plots, *lane, _tabs(words), row_shares=shares)
    else:
        shares = [3.2, *[0.62] * len(lane), 1.1]
        left = rrb.Vertical(views.scene, *lane, _tabs(words), row_shares=shares)
        root = rrb.Horizontal(
            left, rrb.Vertical(*plots, row_shares=heights), column_shares=[1.1, 1.0]
        )
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        _time_panel(live=content.live),
        auto_views=False,
        auto_layout=False,
    )


def _time_panel(*, live: bool) -> rrb.TimePanel:
    if live:
        return rrb.TimePanel(state="collapsed", timeline=SESSION_TIME, play_state="following")
    return rrb.TimePanel(
        state="collapsed", timeline=SESSION_TIME, play_state="playing", loop_mode="all"
    )


def _tabs(views: Sequence[rrb.View]) -> rrb.View | rrb.Tabs:
    return views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)
