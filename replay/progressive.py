"""A session converted stretch by stretch while the viewer shows it.

The viewer gets a layout and the session's first stretch within seconds: what colours and scales
need of the rest is taken from a brief look into it. The rest follows, and the session's numbers as
soon as an analysis in another process has them. Nothing is sent before the viewer has taken what
was sent before it, so one that is slow, or stands still, costs no memory.

What a recording will hold once its session is analysed, as far as that can be told before.

The viewer gets its layout before anything is computed. Views that fill later are there from the
start, so that nothing has to move, or to lose its camera and its place in time, when they do.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import rerun.blueprint as rrb

from undulog.capture import SessionView
from undulog.capture.common.console import Progress
from undulog.capture.common.errors import NoAnswerError, UndulogError
from undulog.capture.common.process import StopRequest
from undulog.capture.common.waits import Standstill, attended

from .draw import mean_cycle
from .draw.drawing import RerunDrawing, Sources, clock_of
from .draw.heat_maps import POWER
from .draw.lines import MODE
from .draw.motion import BODY_RATE_HZ
from .draw.steps import CYCLES
from .layout import build_blueprint, build_views
from .numbers import Analysing
from .recording import open_recording, recording_id, send_properties
from .samples.content import (
    ENERGY,
    GAIN,
    LAG,
    MAPS,
    AwaitedMap,
    Chart,
    Content,
    Layer,
    MeanCycle,
    PlottedSeries,
    Tab,
)
from .samples.quantities import GAIT, Survey, comes, survey
from .samples.timeline import STRETCH_NS, DrawnSpan, LoggedRhythm, SpanSamples, stretches
from .samples.tracks import wanted_fields
from .stream import BoundedStream, keep_for_ever
from .viewer import Viewer

TAKES_S = 300.0
"""Longest time for which the viewer may take nothing of what was sent [s]: a computer that draws
without a graphics card takes tens of seconds for a large stretch."""

_VIEWER = "the Rerun viewer"
_ADVICE = "it is frozen or too busy; the session is unchanged, so start the command again"
ENDS_S = 3.0
"""A viewer that severs the connection is given this time to end, e.g. by a signal [s].

Its memory is given back between the two, which takes long on a busy computer.
"""
_TAKE_S = 0.1  # how long to wait for the viewer between two looks at whether it is still wanted [s]
_FEW_WORDS = 5000  # modes and events that are read before the first picture, at most


def predict_layout(content: Content, rhythm: LoggedRhythm | None) -> Content:
    """Add the views that an analysis of such a session adds.

    Args:
        content: What there is without it.
        rhythm: The gait's phase, or None where none was logged.

    Returns:
        What there will be: bars where joints are commanded and measured; maps, steps and a mean
        cycle where the gait's phase was logged too.
    """
    if not content.commanded or not content.measured:
        return content
    has_power = bool(content.joint_power)
    quantities = (GAIN, LAG, *((ENERGY,) if has_power else ()))
    # What is one a cycle is so in its bar.
    units = [quantity.unit.partition("/")[0] for quantity in quantities]
    charts = tuple(
        Chart(quantity.key, f"{quantity.name} [{unit}]", ())
        for quantity, unit in zip(quantities, units, strict=True)
    )
    if rhythm is None:
        return replace(content, charts=charts)
    measured = _names(content.measured)
    mapped = (GAIN, LAG, *((POWER,) if has_power else ()))
    cycles = abs(float(rhythm.cycles[-1] - rhythm.cycles[0]))
    return replace(
        content,
        charts=charts,
        maps=tuple(
            AwaitedMap(f"{MAPS}/{quantity.key}", f"{quantity.name} map [{quantity.unit}]")
            for quantity in mapped
        ),
        cycles=tuple(
            (quantity, (PlottedSeries(f"{CYCLES}/{quantity.key}", measured),))
            for quantity in quantities
        ),
        mean=MeanCycle(
            period_s=float(np.ptp(rhythm.t_ns)) * 1e-9 / cycles,
            has_body=content.start is not None,
            has_places=content.places is not None,
            measured=_mean_series("measured", measured),
            error=_mean_series("error", _names(content.errors)),
            power=_mean_series("power", _names(content.joint_power)),
        ),
    )


def same_arrangement(first: Content, other: Content) -> bool:
    """Return whether two contents have the same views, so that they can share a layout.

    Returns:
        Whether their views differ in nothing but titles.
    """
    return _arrangement(first) == _arrangement(other)


def _arrangement(content: Content) -> tuple[object, ...]:
    views = tuple(
        (type(view).__name__, str(view.origin), str(view.contents))
        for view in build_views(content).all
    )
    mean = content.mean
    lines = () if mean is None else (mean.measured, mean.error, mean.power)
    return views, lines, content.modes > 1


def _names(series: tuple[PlottedSeries, ...]) -> tuple[str, ...]:
    return tuple(name for channel in series for name in channel.names)


def _mean_series(kind: str, names: tuple[str, ...]) -> tuple[PlottedSeries, ...]:
    return (PlottedSeries(f"{mean_cycle.ENSEMBLE}/{kind}", names),) if names else ()


class NoLongerWantedError(Exception):
    """The viewer was closed, or a stop was requested."""


class _UnforeseenError(Exception):
    """The brief survey missed a line."""


@dataclass(frozen=True)
class Task:
    """A session to be sent to a viewer.

    Attributes:
        layer: Saved results; its numbers are computed if these have none.
        analysing: Its analysis, not started.
        front: The tab in front once its views are filled; until then it is the session's.
        bar: Told how far it is, of :func:`steps`.
        begun: Called when the viewer has the beginning.
    """

    session: SessionView
    layer: Layer
    analysing: Analysing
    front: Tab
    bar: Progress
    begun: Callable[[], None] = lambda: None


@dataclass
class _Sink:
    """The viewer's end of a recording stream."""

    viewer: Viewer
    stop: StopRequest
    streams: list[BoundedStream] = field(default_factory=list[BoundedStream])

    def open(self, identity: str) -> BoundedStream:
        """Open a recording stream, which buffers until it is connected."""
        rec = open_recording(identity)
        rec.look = self.look
        self.streams.append(rec)
        return rec

    def connect(self, rec: BoundedStream, layout: rrb.Blueprint) -> None:
        """Give the viewer its layout, and then the stream: else it makes a layout of its own."""
        self.viewer.wait_until_it_listens()
        connect = partial(rec.connect_grpc, self.viewer.address, default_blueprint=layout)
        try:
            attended(connect, _VIEWER, _ADVICE, limit_s=TAKES_S, look=self.look)
        except BaseException:
            self._leave(rec)
            raise
        # The default alone would give way to the last one; an active one is the user's own.
        rec.send_blueprint(layout)

    def _leave(self, rec: BoundedStream) -> None:
        """Leave a stream behind that stands still: to disconnect it would stand still as well."""
        self.streams.remove(rec)
        keep_for_ever(rec)

    def look(self) -> None:
        """Raise if the viewer has ended or an end is requested."""
        if self.stop.requested:
            raise NoLongerWantedError
        if self.viewer.ended:
            self.viewer.check()
            raise NoLongerWantedError

    def hand_over(self, rec: BoundedStream) -> None:
        """Wait until the viewer has received all data, unless an end is requested.

        Raises:
            NoAnswerError: If the viewer takes nothing within the limit.
        """
        still = Standstill(TAKES_S)
        while True:
            self.look()
            begun = time.monotonic()
            try:
                rec.flush(timeout_sec=_TAKE_S)
            except RuntimeError as error:
                if time.monotonic() - begun < 0.5 * _TAKE_S:  # it did not run out of time
                    while time.monotonic() - begun < ENDS_S:
                        self.look()
                        time.sleep(_TAKE_S)
                    why = "the viewer runs but takes no more of the session"
                    raise UndulogError(f"{why}: {error}") from error
                if still.reached():
                    raise NoAnswerError(_VIEWER, TAKES_S, _ADVICE) from error
            else:
                return


def steps(session: SessionView) -> int:
    """Return the number of steps.

    Returns:
        The number: one a stretch, and one for the analysis.
    """
    return max(1, round((session.end_ns - session.start_ns) / STRETCH_NS)) + 1


def show_session(task: Task, viewer: Viewer, stop: StopRequest) -> tuple[str, ...]:
    """Send a session to a viewer, the beginning first.

    Args:
        task: What is to be shown.
        viewer: The viewer, which may still be starting.
        stop: Looked at now and then.

    Returns:
        What is missing or was assumed, a sentence each.

    Raises:
        NoLongerWantedError: If the viewer was closed, or a stop requested, before all was sent.
        DataError: If the session holds nothing that can be drawn.
        UndulogError: If the viewer fails.
    """
    session = task.session
    sink = _Sink(viewer, stop)
    try:
        surveyed = survey(session, BODY_RATE_HZ, brief=True)
        try:
            return _send(task, sink, surveyed, recording_id(session.session_id))
        except _UnforeseenError as late:
            note = f"drawn anew, as a second recording: the session begins without {late}"
            again = replace(task, layer=replace(task.layer, notes=(*task.layer.notes, note)))
            surveyed = survey(session, BODY_RATE_HZ)
            return _send(again, sink, surveyed, recording_id(f"{session.session_id}/anew"))
    except BaseException:
        viewer.close()  # else what it has not taken would be waited for
        raise
    finally:
        for rec in sink.streams:
            rec.disconnect()


def _send(task: Task, sink: _Sink, surveyed: Survey, identity: str) -> tuple[str, ...]:
    """Draw a session in one recording."""
    session = task.session
    clock = clock_of(session)
    parts = stretches(session, surveyed.topics, surveyed.context_ns)
    first = next(parts)
    rec = sink.open(identity)
    send_properties(rec, session.session_id, session.start_ns)
    drawing = RerunDrawing(
        rec, clock, Sources.of(session, surveyed), task.layer.named, span=first.span
    )
    words_first = _words(session) <= _FEW_WORDS
    if words_first:
        drawing.write_words()
    else:
        drawing.content = replace(drawing.content, modes=2, has_events=True)
    early = predict_layout(drawing.content, clock.rhythm)
    sink.connect(rec, build_blueprint(early))
    drawing.write_facts(session, task.layer, early, awaited=task.layer.analysis is None)
    drawing.write(first)
    sink.hand_over(rec)
    drawn = first.span
    del first
    task.begun()

    if drawn.known_ns is not None:
        drawing.widen(_whole(session, surveyed), DrawnSpan(start_ns=drawn.stop_ns))
    if not words_first:
        drawing.write_words()
    drawing.write_others()
    if task.layer.analysis is None:  # not before: the first picture is still being drawn
        task.analysing.start()
    numbers = _Numbers(task, drawing)
    done = 1
    for stretch in parts:
        _require_nothing_new(stretch, surveyed)
        drawing.write(stretch)
        sink.hand_over(rec)
        numbers.draw()
        done += 1
        task.bar.update(done, note="the rest")
    task.bar.update(done, note="analysis")
    while (layer := numbers.draw()) is None:
        sink.look()
        time.sleep(_TAKE_S)
    facts = drawing.write_facts(session, layer, drawing.content)
    keeps = task.front == "session" and same_arrangement(early, drawing.content)
    # A layout that turned out right is left as it is: the user keeps his tabs and his cameras.
    rec.send_blueprint(build_blueprint(drawing.content, task.front), make_active=not keeps)
    sink.hand_over(rec)
    return tuple(facts)


class _Numbers:
    """The session's numbers, drawn as soon as they are known."""

    def __init__(self, task: Task, drawing: RerunDrawing) -> None:
        self._task, self._drawing = task, drawing
        self._drawn: Layer | None = None

    def draw(self) -> Layer | None:
        """Draw them, unless they are drawn; None as long as they aren't known."""
        if self._drawn is not None:
            return self._drawn
        layer = self._task.layer
        if layer.analysis is None:
            computed = self._task.analysing.layer
            if computed is None:
                return None
            layer = layer.with_numbers(computed)
        self._drawing.write_response(layer)
        self._drawing.write_cycles(layer)
        self._drawing.write_facts(self._task.session, layer, self._drawing.content)
        self._drawn = layer
        return layer


def _whole(session: SessionView, surveyed: Survey) -> Survey:
    """Complete a brief survey as far as the rest of the drawing needs it."""
    if surveyed.is_whole:
        return surveyed
    _require_nothing_else(session, surveyed)
    if "/odom" in session.channels:
        return surveyed
    # The body is drawn at the joints' times.
    return replace(surveyed, drawing_ns=survey(session, BODY_RATE_HZ).drawing_ns)


def _require_nothing_new(stretch: SpanSamples, surveyed: Survey) -> None:
    """Look for joints in a stretch that a brief survey didn't see."""
    for key, tracks in stretch.columns.items():
        new = [track.name for track in tracks if track.name not in surveyed.seen.get(key, ())]
        if new and not surveyed.is_whole:
            raise _UnforeseenError("{} ({}) of {}".format(*key, ", ".join(new)))


def _require_nothing_else(session: SessionView, surveyed: Survey) -> None:
    """Look for fields that begin after all that a brief survey saw."""
    for topic, fields in wanted_fields(session).items():
        for field_name in fields if topic != GAIT else ():
            if field_name not in surveyed.topics.get(topic, ()) and comes(
                session, topic, field_name
            ):
                raise _UnforeseenError(f"{topic} ({field_name})")


def _words(session: SessionView) -> int:
    """Return the number of modes and events."""
    channels = session.channels
    return sum(channels[topic].count for topic in (MODE, "/rosout") if topic in channels)
