"""The views: the body, plots of a stretch about the time cursor, cycles, and the mean cycle.

A plot of a whole hour of samples is slow and shows nothing, so every such plot has a window; what
has one value a cycle is plotted whole. Only what the session holds gets a view.

The layout, made for a laptop's 1440 x 900: a tab each for session, cycles and mean cycle.

In the session's the body is on the left and plots are on the right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.encodings import EntityPathLike

from undulog.capture.robot.model import Plane, Robot

from .draw import body, drawing, lines, mean_cycle
from .draw import stage as trail
from .draw.body import body_title
from .draw.heat_maps import VISIBLE
from .draw.steps import SEGMENTS
from .samples import content as entities
from .samples.content import Content, InitialPose, PlottedSeries, Tab
from .samples.timeline import ENSEMBLE_CYCLE, GAIT_CYCLE, SESSION_TIME

BEFORE_CURSOR_S = 4.0
AFTER_CURSOR_S = 2.0

_ALL = rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())

_BACKGROUND = rrb.Background(color=(16, 18, 22, 255))


@dataclass(frozen=True)
class Views:
    """All views of a recording.

    Attributes:
        scene: The body in space, or None.
        mode: The gait's mode, or None.
        effort: Power and whatever else the joints report.
        bars: Response of each joint.
        steps: Cycle by cycle.
        mean_scene: The body in the mean cycle, or None.
        mean_words: What the mean cycle is.
    """

    scene: rrb.Spatial3DView | None
    mode: rrb.StateTimelineView | None
    words: Sequence[rrb.View]
    angles: Sequence[rrb.View]
    effort: Sequence[rrb.View]
    bars: Sequence[rrb.View]
    maps: Sequence[rrb.View]
    steps: Sequence[rrb.View]
    mean_scene: rrb.Spatial3DView | None
    mean_words: rrb.TextDocumentView | None
    mean_plots: Sequence[rrb.View]

    @property
    def all(self) -> tuple[rrb.View, ...]:
        """Every view, in reading order."""
        session = (self.scene, self.mode, *self.words, *self.angles, *self.effort, *self.bars)
        mean = (self.mean_scene, self.mean_words, *self.mean_plots)
        views = (*session, *self.maps, *self.steps, *mean)
        return tuple(view for view in views if view is not None)


def build_views(content: Content) -> Views:
    """Return the views of a recording's content."""
    words: list[rrb.View] = [rrb.TextDocumentView(name="Session", contents=[drawing.FACTS])]
    if content.has_events:
        words.append(rrb.TextLogView(name="Events", contents=[f"{lines.EVENTS}/**"]))
    mode = rrb.StateTimelineView(name="Gait mode", contents=[lines.MODE])
    about = rrb.TextDocumentView(name="About the mean cycle", contents=[mean_cycle.ABOUT])
    angles, effort = _angle_views(content), _effort_views(content)
    bounds = rrb.VisualBounds2D(x_range=VISIBLE[0], y_range=VISIBLE[1])
    if content.live:  # nothing comes after the cursor
        for angle in (*angles, *effort):
            angle.properties["VisibleTimeRanges"] = _window(BEFORE_CURSOR_S + AFTER_CURSOR_S, 0.0)
    return Views(
        scene=_body_view(content),
        mode=mode if content.modes else None,
        words=words,
        angles=angles,
        effort=effort,
        bars=[bar_chart(chart.title, f"{SEGMENTS}/{chart.key}/**") for chart in content.charts],
        maps=[
            rrb.Spatial2DView(name=heat_map.title, origin=heat_map.entity, visual_bounds=bounds)
            for heat_map in content.maps
        ],
        steps=[
            _whole_plot(
                f"{quantity.name} by cycle [{quantity.unit}]", [part.entity for part in series]
            )
            for quantity, series in content.cycles
        ],
        mean_scene=_mean_scene(content),
        mean_words=None if content.mean is None else about,
        mean_plots=_mean_plots(content),
    )


def _body_view(content: Content) -> rrb.Spatial3DView | None:
    start, robot = content.start, content.robot
    if start is None:
        return None
    span = sum(link.length for link in robot.links) if robot is not None else 1.0
    # From behind its right shoulder and above, where the wave shows along the whole body.
    return rrb.Spatial3DView(
        name=body_title(content),
        origin="/world",
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=_beside(start, (-0.92 * span, -0.55 * span, 0.65 * span)),
            look_target=_beside(start, (-0.5 * span, 0.0, 0.0)),
            eye_up=(0.0, 0.0, 1.0),
            tracking_entity=body.MEASURED,
        ),
        background=_BACKGROUND,
        line_grid=_grid(span),
        overrides={trail.TRAIL: trail_window()},
    )


def _mean_scene(content: Content) -> rrb.Spatial3DView | None:
    if content.mean is None or not content.mean.has_body or content.robot is None:
        return None
    span = sum(link.length for link in content.robot.links)
    # The frame goes along with the body: its middle stays where it is.
    return rrb.Spatial3DView(
        name="Mean cycle: body",
        origin=mean_cycle.BODY,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(-0.35 * span, -0.6 * span, 0.75 * span),
            look_target=(0.0, 0.0, 0.0),
            eye_up=(0.0, 0.0, 1.0),
        ),
        background=_BACKGROUND,
        line_grid=_grid(span),
    )


def _grid(span: float) -> rrb.LineGrid3D:
    return rrb.LineGrid3D(
        visible=True, spacing=_grid_spacing(span), stroke_width=1.0, color=(255, 255, 255, 12)
    )


def _beside(start: InitialPose, offset: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a point given forward, left and up of the head at the start [m]."""
    cos, sin = math.cos(start.heading), math.sin(start.heading)
    x, y, z = start.position
    forward, left, up = offset
    return (x + cos * forward - sin * left, y + sin * forward + cos * left, z + up)


def _grid_spacing(span: float) -> float:
    """Return a round length of at most a fifth of the body [m]."""
    steps = (5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
    return next((step for step in steps if step <= 0.2 * span), 0.01)


def _effort_views(content: Content) -> list[rrb.View]:
    views: list[rrb.View] = []
    if content.has_power:
        views.append(plot("Power [W]", [f"{entities.TOTAL}/**"]))
    if content.joint_power:
        views.append(_joint_plot("Joint power [W]", content.joint_power, None))
    views += [
        _joint_plot(signal.title, signal.series, None, legend=not signal.of_joints)
        for signal in content.signals
    ]
    return views


def bar_chart(title: str, contents: str) -> rrb.BarChartView:
    """Return a view of bars without a legend."""
    legend = rrb.PlotLegend(visible=False)
    return rrb.BarChartView(name=title, contents=[contents], plot_legend=legend)


def _mean_plots(content: Content) -> list[rrb.View]:
    mean = content.mean
    if mean is None:
        return []
    views: list[rrb.View] = []
    if mean.has_places:
        corner = rrb.Corner2D.LeftBottom  # where a sine isn't
        contents = [f"{mean_cycle.PLACES}/**"]
        views.append(_whole_plot("Mean angle [°]", contents, legend=corner))
    names = _plane_of_places(content)
    for title, series, shown in (
        ("Mean angle of all joints [°]", mean.measured, names),
        ("Mean error [°]", mean.error, names),
        ("Mean power [W]", mean.power, None),
    ):
        if series:
            contents = [channel.entity for channel in series]
            views.append(_whole_plot(title, contents, overrides=_lines(series, shown)))
    return views


def _angle_views(content: Content) -> list[rrb.View]:
    views: list[rrb.View] = []
    if content.places is not None:
        title = "Head, middle, tail [°]" if len(content.places.names) == 3 else "Angle [°]"
        views.append(plot(title, [f"{lines.PLACES}/**"]))
    for plane in Plane:
        names = _names(content.robot, plane)
        if names & {name for series in content.measured for name in series.names}:
            views.append(_joint_plot(f"{plane.capitalize()} [°]", content.measured, names))
    if content.robot is None and content.measured:
        views.append(_joint_plot("Measured [°]", content.measured, None))
    if content.errors:
        views.append(_joint_plot("Error [°]", content.errors, _plane_of_places(content)))
    if not views and content.commanded:
        views.append(_joint_plot("Commanded [°]", content.commanded, None))
    return views


def _names(robot: Robot | None, plane: Plane) -> set[str]:
    joints = () if robot is None else robot.joints
    return {joint.name for joint in joints if joint.plane is plane}


def _plane_of_places(content: Content) -> set[str] | None:
    """Joints of the plane that head, middle and tail bend; None where it isn't known."""
    plane = None if content.places is None else content.places.plane
    return None if plane is None else _names(content.robot, plane)


def _joint_plot(
    title: str, series: Sequence[PlottedSeries], names: set[str] | None, *, legend: bool = False
) -> rrb.TimeSeriesView:
    """Return a plot with a line for each joint; ``names`` are visible at first."""
    contents = [channel.entity for channel in series]
    return plot(title, contents, overrides=_lines(series, names), legend=legend)


def _lines(
    series: Sequence[PlottedSeries], names: set[str] | None
) -> dict[EntityPathLike, rrb.Visualizer]:
    visualizers: dict[EntityPathLike, rrb.Visualizer] = {}
    for plotted in series:
        shown = [names is None or name in names for name in plotted.names]
        source = VisualizerComponentMapping(
            entities.SCALARS,
            ComponentSourceKind.SourceComponent,
            source_component=plotted.component,
        )
        look = rr.SeriesLines.from_fields(visible_series=shown)
        visualizers[plotted.entity] = look.visualizer(mappings=[source])
    return visualizers


def _whole_plot(
    title: str,
    contents: list[str],
    *,
    overrides: Mapping[EntityPathLike, rrb.Visualizer] | None = None,
    legend: rrb.Corner2D | None = None,
) -> rrb.TimeSeriesView:
    """Return a plot of the whole timeline, independent of the cursor."""
    return rrb.TimeSeriesView(
        name=title,
        contents=contents,
        overrides=overrides,
        plot_legend=rrb.PlotLegend(legend, visible=legend is not None),
        axis_x=rrb.TimeAxis(view_range=_ALL),
    )


def plot(
    title: str,
    contents: list[str],
    *,
    overrides: Mapping[EntityPathLike, rrb.Visualizer] | None = None,
    legend: bool = True,
) -> rrb.TimeSeriesView:
    """Return a plot about the time cursor."""
    return rrb.TimeSeriesView(
        name=title,
        contents=contents,
        overrides=overrides,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
        time_ranges=_window(BEFORE_CURSOR_S, AFTER_CURSOR_S),
    )


def trail_window() -> rrb.VisibleTimeRanges:
    """Return the visible part of the head's trail."""
    return _window(trail.TRAIL_SECONDS, 0.0, SESSION_TIME)


def _window(before_s: float, after_s: float, *timelines: str) -> rrb.VisibleTimeRanges:
    """Return a window about the cursor, by default on the session's timelines."""
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-before_s)
    end = rrb.TimeRangeBoundary.cursor_relative(seconds=after_s)
    names = timelines or (SESSION_TIME, GAIT_CYCLE)
    ranges = [rrb.VisibleTimeRange(name, start=start, end=end) for name in names]
    return rrb.VisibleTimeRanges(ranges)


def build_blueprint(content: Content, front: Tab = "session") -> rrb.Blueprint:
    """Lay out the views of a recording's content.

    Args:
        front: The tab in front; the session's where the recording has no such tab. In front, the
            mean cycle plays on its own timeline.

    Returns:
        The blueprint, with the viewer's own panels folded away; it opens playing, or
        following the end of what still grows.
    """
    views = build_views(content)
    pages: dict[Tab, rrb.Container] = {"session": _session(content, views)}
    if views.maps or views.steps:
        rows = [rrb.Horizontal(*row) for row in (views.maps, views.steps) if row]
        pages["cycles"] = rrb.Vertical(*rows, row_shares=[1.35, 1.0][: len(rows)], name="Cycles")
    if views.mean_plots and views.mean_words is not None:
        pages["mean-cycle"] = _mean(views, views.mean_words)
    shown: Tab = front if front in pages else "session"
    root = pages[shown]
    if len(pages) > 1:
        root = rrb.Tabs(*pages.values(), active_tab=list(pages).index(shown))
    timeline = ENSEMBLE_CYCLE if shown == "mean-cycle" else SESSION_TIME
    return blueprint(root, _time_panel(content, timeline))


def blueprint(root: rrb.View | rrb.Container, time_panel: rrb.TimePanel) -> rrb.Blueprint:
    """A layout that is ours alone, the viewer's own panels folded away."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        time_panel,
        auto_views=False,
        auto_layout=False,
    )


def _session(content: Content, views: Views) -> rrb.Container:
    # A mode that never changes isn't worth a lane of its own.
    lane = [views.mode] if views.mode is not None and content.modes > 1 else []
    words = [*views.words, *([views.mode] if views.mode is not None and not lane else [])]
    groups = [group for group in (views.angles, views.effort) if group]
    plots: list[rrb.View | rrb.Container] = [tabs(group) for group in groups]
    heights = [3.0, 2.4][: len(plots)]
    if views.bars:
        plots.append(rrb.Horizontal(*views.bars))
        heights.append(3.0)
    if views.scene is None:
        shares = [*heights, *[0.8] * len(lane), 2.0]
        return rrb.Vertical(*plots, *lane, tabs(words), row_shares=shares, name="Session")
    shares = [3.2, *[0.62] * len(lane), 1.1]
    left = rrb.Vertical(views.scene, *lane, tabs(words), row_shares=shares)
    right = rrb.Vertical(*plots, row_shares=heights)
    return rrb.Horizontal(left, right, column_shares=[1.1, 1.0], name="Session")


def _mean(views: Views, words: rrb.TextDocumentView) -> rrb.Container:
    first, *others = views.mean_plots
    right = rrb.Vertical(first, *([tabs(others)] if others else []))
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


def tabs(
    views: Sequence[rrb.View] | Sequence[rrb.Horizontal],
) -> rrb.View | rrb.Horizontal | rrb.Tabs:
    """Views behind each other; a single one as it is."""
    return views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)
