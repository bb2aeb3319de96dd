"""Draws a recording while it is made, with the entities, colours and views of its replay.

Single samples are drawn at once; quantities of several samples (the body, power, the tracking
error) are computed over the last seconds, with the replay's own functions, and drawn up to the time
at which all of their inputs have been received.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray, IntArray

from ..draw.drawing import palette_of, start_of
from ..draw.facts import code, document, listed, log_facts
from ..draw.plots import lines
from ..draw.scene import body, stage
from ..draw.scene.motion import BODY_RATE_HZ, SPARSE_RATE_HZ, HeadPath, Motion, assemble, still_head
from ..layout import build_blueprint
from ..samples import content as entities
from ..samples import quantities
from ..samples.content import Content, Signal, Start, signal_title
from ..samples.quantities import DRAWN, SIGNALS, power_limit, topic_entity
from ..samples.timeline import Clock
from ..samples.tracks import Columns, Track, hold, ordered
from .cycles import CycleMeter
from .decode import PATIENCE_NS, Batch, LiveLog
from .plot import CycleBars, LivePlot

_LAYOUT_EVERY_S = 1.0
_FACTS_EVERY_S = 2.0
_PLACES_EVERY_S = 0.2
_TAIL_NS = round(1e9 / stage.TRAIL_RATE_HZ)
_CLEARER = 2.0  # another plane's joints are plotted once they swing so many times as far


_KEPT_NS = 2_000_000_000  # length of a window


class _Window:
    """Samples of the last seconds."""

    def __init__(self) -> None:
        """Start empty."""
        self.head: HeadPath | None = None
        self.ranges: dict[str, tuple[IntArray, FloatArray]] = {}
        self._tracks: dict[tuple[str, str], dict[str, Track]] = {}
        self._newest_ns = 0

    @property
    def columns(self) -> Columns:
        """All JointState columns."""
        return {key: tuple(tracks.values()) for key, tracks in self._tracks.items()}

    def tracks(self, topic: str, field: str = "position") -> tuple[Track, ...]:
        """One column.

        Args:
            topic: E.g. ``/joint_states``.
            field: ``position``, ``velocity`` or ``effort``.

        Returns:
            A track a joint; none where nothing has come.
        """
        return tuple(self._tracks.get((topic, field), {}).values())

    def add(self, batch: Batch) -> None:
        """Take new samples, and forget the oldest."""
        for key, tracks in batch.columns.items():
            own = self._tracks.setdefault(key, {})
            for track in tracks:
                old = own.get(track.name)
                kept = None if old is None else (old.t_ns, old.values)
                own[track.name] = Track(track.name, *_grown(kept, track.t_ns, track.values))
        for topic, (t_ns, values) in batch.ranges.items():
            self.ranges[topic] = _grown(self.ranges.get(topic), t_ns, values)
        if batch.head is not None:
            self.head = _joined(self.head, batch.head)
        ends = [one.t_ns[-1] for tracks in batch.columns.values() for one in tracks]
        self._newest_ns = max([self._newest_ns, *map(int, ends)])

    def ready_ns(self, inputs: Iterable[Sequence[Track]], *others: IntArray) -> int:
        """Return the time up to which a quantity can be computed from all of its inputs.

        Args:
            inputs: Tracks that it is computed from.
            others: Times of further inputs [ns].

        Returns:
            The earliest of the inputs' last times, but no more than the patience before the newest
            sample of all [ns].
        """
        ends = [int(track.t_ns[-1]) for tracks in inputs for track in tracks if track.t_ns.size]
        ends += [int(t_ns[-1]) for t_ns in others if t_ns.size]
        return max(min(ends, default=0), self._newest_ns - PATIENCE_NS)


class _Fresh:
    """Remembers up to where something has been drawn."""

    def __init__(self) -> None:
        """Nothing has been drawn."""
        self._until_ns: dict[str, int] = {}

    def rows(self, name: str, t_ns: IntArray, upto_ns: int | None = None) -> slice:
        """Return which samples are new, and mark them as drawn.

        Args:
            t_ns: Their times [ns], ascending, shape (n,).
            upto_ns: The last time that can be drawn [ns]; None for all.
        """
        start = int(np.searchsorted(t_ns, self._until_ns.get(name, -1), side="right"))
        stop = t_ns.size
        if upto_ns is not None:
            stop = int(np.searchsorted(t_ns, upto_ns, side="right"))
        if stop > start:
            self._until_ns[name] = int(t_ns[stop - 1])
        return slice(start, max(start, stop))

    def tracks(
        self, name: str, tracks: Iterable[Track], upto_ns: int | None = None
    ) -> tuple[Track, ...]:
        """Return the new samples of tracks, and mark them as drawn.

        Args:
            upto_ns: The last time that can be drawn [ns]; None for all.

        Returns:
            Those that have new samples, with these only.
        """
        found: list[Track] = []
        for track in tracks:
            rows = self.rows(f"{name}/{track.name}", track.t_ns, upto_ns)
            if rows.stop > rows.start:
                found.append(Track(track.name, track.t_ns[rows], track.values[rows]))
        return tuple(found)


def _grown(
    old: tuple[IntArray, FloatArray] | None, t_ns: IntArray, values: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Append new samples to those of the last seconds before them."""
    if old is None:
        return t_ns, values
    if not t_ns.size:
        return old
    first = int(np.searchsorted(old[0], int(t_ns[0]) - _KEPT_NS))
    return ordered(np.concatenate([old[0][first:], t_ns]), np.concatenate([old[1][first:], values]))


def _joined(old: HeadPath | None, new: HeadPath) -> HeadPath:
    """Append a tracked head's path to that of the last seconds before it."""
    kept = None if old is None else (old.t_ns, old.pose)
    return HeadPath.of(*_grown(kept, new.t_ns, new.pose), tracked=True)


class LiveScene:
    """One recording as it grows."""

    def __init__(
        self, rec: rr.RecordingStream, log: LiveLog, session_id: str, epoch_ns: int
    ) -> None:
        """Draw nothing yet.

        Args:
            log: What is known of the recording.
            session_id: The session's id.
            epoch_ns: Where ``session_time`` starts [Unix ns].
        """
        self._rec, self._log, self._session_id = rec, log, session_id
        self._clock = Clock(epoch_ns)
        self._window, self._fresh = _Window(), _Fresh()
        self._measured = LivePlot(entities.MEASURED, degrees=True)
        self._commanded = LivePlot(entities.COMMANDED, degrees=True)
        self._errors = LivePlot(entities.ERROR, degrees=True)
        self._joint_power = LivePlot(entities.MECHANICAL)
        self._meter, self._bars = CycleMeter(epoch_ns), CycleBars()
        self._signals: dict[str, tuple[LivePlot, bool]] = {}  # and whether it is of the joints
        self._palette: dict[str, entities.Color] = {}
        self._places: entities.Places | None = None
        self._place_plots: dict[tuple[str, tuple[str, ...]], LivePlot] = {}
        self._start: Start | None = None
        self._origin_ns: int | None = None
        self._limit_w: float | None = None
        self._mode: str | None = None
        self._mode_ns = 0
        self._modes = 0
        self._has_events = self._has_power = False
        self._trail_end: HeadPath | None = None
        self._laid_out: tuple[object, ...] = ()
        self._layout_at = self._facts_at = self._places_at = 0.0

    @property
    def content(self) -> Content:
        """Content that has been drawn so far."""
        return Content(
            robot=self._log.robot,
            start=self._start,
            power_limit_w=self._limit_w,
            places=self._places,
            commanded=self._commanded.series,
            measured=self._measured.series,
            errors=self._errors.series,
            has_power=self._has_power,
            joint_power=self._joint_power.series,
            charts=self._bars.charts,
            cycles=self._bars.cycles,
            modes=min(self._modes, 2),  # one or several: more lay out nothing anew
            has_events=self._has_events,
            signals=tuple(
                Signal(signal_title(topic, self._log.unit(topic)), plot.series, of_joints)
                for topic, (plot, of_joints) in self._signals.items()
            ),
            live=True,
        )

    def draw(self, batch: Batch, dropped: int = 0) -> None:
        """Draw new samples.

        Args:
            dropped: Messages that could not be shown so far.
        """
        self._window.add(batch)
        tracks = self._window.tracks("/joint_states") or self._window.tracks("/joint_commands")
        palette = palette_of(self._log.robot, [track.name for track in tracks])
        self._draw_angles(batch, palette)
        self._draw_power(palette)
        self._draw_signals(batch, palette)
        self._draw_words(batch)
        self._draw_body(palette)
        for cycle in self._meter.add(batch, self._log.robot):
            self._bars.take(cycle)
        self._bars.write(self._rec, self._clock, palette)
        self._palette = palette
        self._lay_out(dropped)

    def finish(self, dropped: int = 0) -> None:
        """Draw the end of the recording.

        Args:
            dropped: Messages that could not be shown.
        """
        self._bars.write(self._rec, self._clock, self._palette, everything=True)
        self._layout_at = self._facts_at = 0.0
        self._lay_out(dropped, ended=True)

    # -- plots -----------------------------------------------------------------------------

    def _draw_angles(self, batch: Batch, palette: dict[str, entities.Color]) -> None:
        rec, clock = self._rec, self._clock
        measured = batch.columns.get(("/joint_states", "position"), ())
        commanded = batch.columns.get(("/joint_commands", "position"), ())
        self._measured.write(rec, clock, measured, palette)
        self._commanded.write(rec, clock, commanded)
        window = self._window.tracks("/joint_states"), self._window.tracks("/joint_commands")
        new = self._fresh.tracks("error", window[0])
        self._errors.write(rec, clock, quantities.tracking_errors(new, window[1]), palette)
        self._choose_places(window[1] or window[0])
        self._draw_places("measured", measured, palette)
        self._draw_places("commanded", commanded, None)

    def _draw_places(
        self, kind: str, tracks: tuple[Track, ...], palette: dict[str, entities.Color] | None
    ) -> None:
        """Add a plot of head, middle and tail alone, which can be read at a glance."""
        places = self._places
        if places is None:
            return
        look = lines.places_look(places, kind)
        entity = f"{lines.PLACES}/{kind}"
        new = LivePlot(entity, degrees=True, component=entities.SCALARS, **look)
        plot = self._place_plots.setdefault((kind, places.names), new)
        own = [track for track in tracks if track.name in places.names]
        plot.write(self._rec, self._clock, own, palette)

    def _choose_places(self, moving: tuple[Track, ...]) -> None:
        """Choose head, middle and tail of the plane that moves, once it is clear which does."""
        now = time.monotonic()
        if self._places is not None and now < self._places_at:
            return
        self._places_at = now + _PLACES_EVERY_S
        found = lines.head_middle_tail(self._log.robot, moving)
        if found is None or found == self._places:
            return
        if self._places is not None and self._places.plane is not found.plane:
            swing = {track.name: float(np.nanstd(track.values)) for track in moving}
            before, after = (
                max(swing.get(name, 0.0) for name in one.names) for one in (self._places, found)
            )
            if after < _CLEARER * before + 1e-3:
                return
        self._places = found

    def _draw_power(self, palette: dict[str, entities.Color]) -> None:
        columns = self._window.columns
        mechanical = quantities.mechanical_power(columns)
        electrical = quantities.electrical_power(columns)
        for kind, tracks in (("electrical", electrical), ("mechanical", mechanical)):
            whole = quantities.total(tracks)
            upto_ns = self._window.ready_ns([tracks])
            for part in self._fresh.tracks(kind, [whole] if whole else [], upto_ns):
                lines.log_sum(self._rec, self._clock, kind, part)
                self._has_power = True
        fresh = self._fresh.tracks("power", mechanical, self._window.ready_ns([mechanical]))
        self._joint_power.write(self._rec, self._clock, fresh, palette)

    def _draw_signals(self, batch: Batch, palette: dict[str, entities.Color]) -> None:
        for (topic, field), tracks in batch.columns.items():
            if topic in DRAWN or field != "position":
                continue
            names = [track.name for track in self._window.tracks(topic)]
            of_joints = bool(set(names) & set(palette))
            colors = palette if of_joints else lines.joint_palette(names)
            known = self._signals.get(topic)
            plot = known[0] if known else LivePlot(topic_entity(SIGNALS, topic))
            self._signals[topic] = plot, of_joints
            plot.write(self._rec, self._clock, tracks, colors)

    def _draw_words(self, batch: Batch) -> None:
        turns: list[tuple[int, str]] = []
        for t_ns, mode in batch.modes:
            if t_ns > self._mode_ns:  # the current mode is repeated
                if mode != self._mode:
                    turns.append((t_ns, mode))
                self._mode, self._mode_ns = mode, t_ns
        self._modes += len(turns)
        lines.log_states(self._rec, self._clock, turns)
        lines.log_lines(self._rec, self._clock, batch.events)
        self._has_events |= bool(batch.events)

    # -- the body --------------------------------------------------------------------------

    def _draw_body(self, palette: dict[str, entities.Color]) -> None:
        robot, positions = self._log.robot, self._window.tracks("/joint_states")
        if robot is None or not positions:
            return
        head = self._window.head or still_head(positions[0].t_ns)
        columns = self._window.columns
        drive = quantities.mechanical_power(columns)
        upto_ns = self._window.ready_ns([positions, drive], head.t_ns)
        fresh = self._fresh.rows("body", head.t_ns, upto_ns)
        chosen = self._slots(head.t_ns, BODY_RATE_HZ)
        sparse = chosen[self._slots(head.t_ns[chosen], SPARSE_RATE_HZ)]
        chosen = chosen[(chosen >= fresh.start) & (chosen < fresh.stop)]
        if not chosen.size:
            return
        sparse = np.flatnonzero(np.isin(chosen, sparse))
        motion = assemble(robot, head.at(chosen), columns)
        rec, clock = self._rec, self._clock
        if self._start is None:
            self._start = start_of(motion.head)
            rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._scale(drive)
        body.log_body(rec, clock, motion, limit_w=self._limit_w)
        body.log_ghost(rec, clock, motion, sparse)
        self._draw_ranges(motion, sparse)
        body.log_markers(rec, clock, motion, self._places, palette, named=sparse)
        if head.tracked:
            self._draw_trail(motion.head)

    def _slots(self, t_ns: IntArray, rate_hz: float) -> IntArray:
        """At most so many of the rows a second; :func:`~.replay.samples.tracks.decimate` chooses.

        The slots start with the first row of all, so that it doesn't matter where a batch ends.
        """
        if self._origin_ns is None and t_ns.size:
            self._origin_ns = int(t_ns[0])
        period = round(1e9 / rate_hz)
        slot = (t_ns - (self._origin_ns or 0) + period // 4) // period
        return np.flatnonzero(np.diff(slot, prepend=slot[:1] - 1)).astype(np.int64)

    def _scale(self, drive: tuple[Track, ...]) -> None:
        """Increase the colours' full power with the measured power, in steps of 1, 2, 5."""
        if not drive:
            return
        seen = power_limit(np.concatenate([track.values for track in drive]))
        if self._limit_w is None or seen > self._limit_w:
            decade = 10.0 ** np.floor(np.log10(seen) + 1e-9)
            self._limit_w = float(
                decade * next(s for s in (1, 2, 5, 10) if seen <= s * decade * (1 + 1e-9))
            )

    def _draw_ranges(self, motion: Motion, chosen: IntArray) -> None:
        known, at_ns = self._window.ranges, motion.t_ns[chosen]
        sensors = stage.range_sensors(motion.robot, known)
        if sensors:
            reading = np.stack([hold(*known[one.topic], at_ns) for one in sensors], axis=1)
            stage.log_rays(self._rec, self._clock, motion, chosen, sensors=sensors, reading=reading)

    def _draw_trail(self, head: HeadPath) -> None:
        """Draw the head's path from the last drawn point, ten points a second."""
        for row in range(head.t_ns.size):
            point = head.at(slice(row, row + 1))
            last = self._trail_end
            if last is not None:
                if point.t_ns[0] - last.t_ns[0] < _TAIL_NS:
                    continue
                stage.log_trail(self._rec, self._clock, _joined(last, point))
            self._trail_end = point

    # -- layout ----------------------------------------------------------------------------

    def _lay_out(self, dropped: int, *, ended: bool = False) -> None:
        """Send the layout when there is something new to lay out, and the facts."""
        content, now = self.content, time.monotonic()
        if now >= self._facts_at:
            self._facts_at = now + _FACTS_EVERY_S
            log_facts(self._rec, self._facts(content, dropped, ended=ended))
        shape = _shape(content)
        if now < self._layout_at or shape == self._laid_out:
            return
        self._layout_at = now + _LAYOUT_EVERY_S
        self._laid_out = shape
        self._rec.send_blueprint(build_blueprint(content))

    def _facts(self, content: Content, dropped: int, *, ended: bool) -> str:
        """Return the session's facts as text, as in :mod:`.replay.draw.facts`."""
        robot = content.robot
        start = datetime.fromtimestamp(self._clock.start_ns // 1_000_000_000, UTC)
        made = "no robot description"
        if robot is not None:
            made = f"{robot.name}, {len(robot.joints)} joints"
        facts = [code(self._session_id), made, f"since {start:%Y-%m-%d %H:%M:%S} UTC"]
        notes = list(self._log.notes)
        if robot is not None and self._window.head is None:
            notes.append("no /odom: the head is held at the origin")
        if dropped:
            notes.append(f"{dropped} messages were not shown here; what is recorded is not touched")
        legend = f"{body.body_title(replace(content, live=False))}. Grey is commanded."
        if content.charts:
            legend += " Bars are the last whole cycle of the gait."
        first = "Recorded." if ended else "Recording."
        return document([f"**{first}**", " · ".join(facts), listed(notes), legend])


def _shape(content: Content) -> tuple[object, ...]:
    """Return the content that determines the layout: whether there is a robot, not which."""
    bare = replace(content, robot=None, start=None, power_limit_w=None)
    return content.robot is None, content.start is None, content.power_limit_w is None, bare
